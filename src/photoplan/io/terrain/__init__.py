"""Terrain data in and out, one format in each file, and the file of a terrain model."""
