"""Report of the bundle adjustment."""
