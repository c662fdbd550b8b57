"""Contour lines."""
