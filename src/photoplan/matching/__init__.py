"""Matching: features, tie points, patches found again in other images."""
