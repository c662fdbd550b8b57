"""Contradictions in measured points and lines, cleaned or reported."""
