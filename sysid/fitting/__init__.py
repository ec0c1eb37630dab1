"""The error of parameters, and its local refinement."""
