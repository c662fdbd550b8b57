"""Orientations and cameras in everyone's files, one format in each."""
