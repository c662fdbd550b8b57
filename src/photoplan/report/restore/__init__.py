"""Reports of restorations and pictures of filters."""
