"""The file that describes a series of frames, and its frames."""
