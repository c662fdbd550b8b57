"""Reports of edges and test patterns."""
