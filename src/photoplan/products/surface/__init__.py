"""Surfaces from images: heights and grey values with their standard deviations, by facets stereo vision."""
