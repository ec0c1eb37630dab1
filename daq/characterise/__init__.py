"""A rig's parameters by itself: run, identify, design, run, until they are known well enough."""
