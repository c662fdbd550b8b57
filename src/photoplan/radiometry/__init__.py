"""Even colours between images: tables and trends that make them agree where they show the same ground."""
