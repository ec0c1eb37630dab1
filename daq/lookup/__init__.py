"""From names that users write to experiments, rigs, models and files."""
