"""Triangles of a hybrid model where lines pass."""
