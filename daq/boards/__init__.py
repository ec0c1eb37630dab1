"""Data acquisition cards of other makers as devices.

``device`` makes a ``daq.hal.Device`` of whatever does what ``card`` asks for; ``quanser`` and
``nidaqmx`` are the two cards there are.
"""
