"""Cameras measured from series of frames: noise, linearity, patterns, defects, light, time, geometry."""
