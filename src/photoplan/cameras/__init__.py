"""Cameras: mappings from ground to image, one kind per file, behind the protocol of `base`."""
