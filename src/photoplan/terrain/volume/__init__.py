"""Volumes and their standard deviations."""
