"""Edges of images: found, measured, summed up: spread functions and MTF with intervals."""
