"""Watchdogs of cards."""

from nidaqmx._driver import WatchdogTask

__all__ = ["WatchdogTask"]
