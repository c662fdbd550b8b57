"""`photoplan adjust`: bundle adjustment of a project."""
