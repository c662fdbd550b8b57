"""Perspective views: what is seen from a point, the ground of every pixel, and pictures of it."""
