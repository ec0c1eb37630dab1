"""Faults of a computer, a rig or a run, each with its cure."""
