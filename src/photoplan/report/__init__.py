"""Reports for people: HTML pages with plots."""
