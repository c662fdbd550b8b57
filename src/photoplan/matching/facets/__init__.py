"""Facets stereo vision: heights and grey values of a surface from the grey values of all images at once."""
