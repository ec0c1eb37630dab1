"""Reports of identifications: a page for people, a table for papers."""
