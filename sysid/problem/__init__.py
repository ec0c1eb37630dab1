"""What is to be identified: model, records, search space, figures of merit."""
