"""Configuration files: typed, with errors that point at the line."""
