"""Lenses: how a real lens deviates from central projection, one kind per file."""
