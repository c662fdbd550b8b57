"""Seams of a mosaic, found in what its images show."""
