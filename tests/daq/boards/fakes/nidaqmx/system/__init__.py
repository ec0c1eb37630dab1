"""The cards of this computer."""

from nidaqmx._driver import Device

__all__ = ["Device"]
