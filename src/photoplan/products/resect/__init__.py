"""Space resection of the images of a project."""
