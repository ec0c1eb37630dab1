"""What may be wrong with a computer, a rig or a run, each with its cure."""
