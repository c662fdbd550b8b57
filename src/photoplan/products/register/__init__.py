"""Registration of two images against each other."""
