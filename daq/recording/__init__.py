"""Experiments from file to findings: previewed, recorded, analysed."""
