"""Orthophotos: planned, looked at, executed."""
