"""Reading and writing of terrain data, one module for each family of formats, and the file of a terrain model."""
