"""Control points from an old orthophoto and a height model."""
