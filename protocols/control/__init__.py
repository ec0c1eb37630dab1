"""Controllers that answer every sample, and the settings of their loops."""
