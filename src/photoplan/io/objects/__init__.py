"""Objects on the terrain: houses, bridges, trees; one format per file."""
