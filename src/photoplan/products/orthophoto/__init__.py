"""Orthophotos, mosaics and single objects: plans, their inspection, and their execution."""
