"""Products' own coordinates and where they are on the ground."""
