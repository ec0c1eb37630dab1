"""Figures of logs and identifications: each a function from arrays to a matplotlib figure.

They know no rig and no model. ``style`` holds what all of them share, and turns a figure into a
file's bytes; no figure touches pyplot, so nothing is global.
"""
