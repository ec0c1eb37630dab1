"""The batch simulator: a model's equations made machine code, populations at vector speed."""
