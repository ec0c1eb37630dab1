"""Commands known beforehand: channels around an offset, smooth ends, whole samples."""
