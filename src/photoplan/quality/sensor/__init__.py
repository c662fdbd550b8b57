"""Figures of a sensor from its description."""
