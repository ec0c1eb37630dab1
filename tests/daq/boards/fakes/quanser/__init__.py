"""The part of the Quanser SDK's Python packages that a fake card needs."""
