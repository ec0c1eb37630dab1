"""Experiments designed for a rig: from a question to files that ``rig run`` runs."""
