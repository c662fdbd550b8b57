"""Execution of tiles: the only place where pixels are resampled."""
