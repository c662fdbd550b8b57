"""Least squares once: scales, weights, linear and iterated fits with their accuracy, tests, and blocks of unknowns."""
