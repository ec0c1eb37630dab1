"""The device's side of the serial protocol, with whatever may go wrong on it."""
