"""Requests by group of commands: the options of each operation, declared once."""
