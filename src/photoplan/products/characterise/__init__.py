"""`photoplan characterise`: the analyses of a camera that a series of frames allows, each in a file."""
