"""Readers of samples."""

from nidaqmx._driver import AnalogMultiChannelReader, CounterReader

__all__ = ["AnalogMultiChannelReader", "CounterReader"]
