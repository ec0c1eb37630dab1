"""Enumerations of the HIL library, with the values of its C header."""


class BufferOverflowMode:
    """What a task does where its buffer is full."""

    ERROR_ON_OVERFLOW = 0
    OVERWRITE_ON_OVERFLOW = 1
    DISCARD_ON_OVERFLOW = 2
    WAIT_ON_OVERFLOW = 3
    SYNCHRONIZE = 4


class Clock:
    """Clocks of a card."""

    SYSTEM_CLOCK_1 = -1
    HARDWARE_CLOCK_0 = 0
    HARDWARE_CLOCK_1 = 1


class EncoderQuadratureMode:
    """Counts for each cycle of an encoder."""

    NONE = 0
    X1 = 1
    X2 = 2
    X4 = 4
