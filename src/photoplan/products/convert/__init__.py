"""Orientations from one format into another."""
