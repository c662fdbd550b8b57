"""Edges of images: found, measured and combined into spread functions and MTF with confidence intervals."""
