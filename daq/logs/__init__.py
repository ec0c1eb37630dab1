"""Logs of samples, the tables they are written in, and the capture folders they lie in."""
