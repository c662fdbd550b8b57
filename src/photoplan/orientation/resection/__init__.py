"""Space resection of single images."""
