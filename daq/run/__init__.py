"""One run: a protocol asked for commands, a rig sampled, limits watched, everything logged."""
