"""`photoplan characterise`: analyses of a camera from a series of frames, each in a module."""
