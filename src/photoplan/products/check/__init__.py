"""What to expect of a project, and whether its parts fit together."""
