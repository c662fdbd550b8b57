"""Orientation: fiducial marks, interior orientation, resection, intersection, bundle adjustment."""
