"""Least squares: scales, weights, linear and iterated fits with their accuracy, tests, blocks of unknowns."""
