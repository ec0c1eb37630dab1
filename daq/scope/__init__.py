"""A page that shows a run's log while it grows; the run knows nothing of it."""
