"""What follows from a run: fits, bounds of theory, and the findings made of them."""
