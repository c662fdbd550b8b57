"""Terrain models: linear prediction from measured points and lines, and what is derived from models."""
