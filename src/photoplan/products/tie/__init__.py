"""Tie points between the images of a project."""
