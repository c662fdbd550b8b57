"""Image quality: spread functions and MTF measured, images restored, cameras characterised. Values only, no files."""
