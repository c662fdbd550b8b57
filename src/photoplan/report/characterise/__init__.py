"""Report of what a series of images tells of a camera."""
