"""Tiles executed: the only place where pixels are resampled."""
