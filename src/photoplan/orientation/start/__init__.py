"""Orientation from nothing: relative orientation, models that grow, similarity."""
