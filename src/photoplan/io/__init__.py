"""Reading and writing of files, by kind of content."""
