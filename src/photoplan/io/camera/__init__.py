"""Descriptions of cameras in files."""
