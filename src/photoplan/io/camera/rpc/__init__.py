"""Rational polynomials of satellite images, from the files that they are delivered in; one file per format."""
