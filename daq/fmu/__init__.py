"""Models for other simulators: functional mock-up units (FMI 3.0, co-simulation)."""
