"""`balance`: tables by which the images of a project agree in colour."""
