"""Writers of samples."""

from nidaqmx._driver import AnalogMultiChannelWriter

__all__ = ["AnalogMultiChannelWriter"]
