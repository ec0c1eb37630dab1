"""Names of the files of a design, beside its experiments."""

DATA, FIGURE, COMMANDS = "design.json", "design.png", "commands.txt"
