"""Orientation file formats, one module for each family; the registry is `photoplan.io.formats.FORMATS`."""
