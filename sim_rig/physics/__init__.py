"""Equations and parameters of the actuator's parts."""
