"""Shading, slope and tints."""
