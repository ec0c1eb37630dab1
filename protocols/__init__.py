"""Experiments: each protocol is one file, with its shipped YAML beside it."""
