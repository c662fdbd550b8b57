"""Rotations, poses, grids, reference systems and height systems."""
