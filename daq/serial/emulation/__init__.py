"""The device's side of the serial protocol, with faults on request."""
