"""A project file from the files that users have."""
