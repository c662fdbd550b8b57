"""`photoplan dtm`: terrain models built, shown and used."""
