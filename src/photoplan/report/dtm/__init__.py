"""Reports and pictures of terrain models."""
