"""Fiducial marks of the scans of a project."""
