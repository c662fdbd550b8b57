"""`photoplan mtf`: sharpness at edges and test patterns."""
