"""Enumerations of the package."""

from enum import Enum

READ_ALL_AVAILABLE = -1


class AcquisitionType(Enum):
    """How many samples."""

    FINITE = 10178
    CONTINUOUS = 10123
    HW_TIMED_SINGLE_POINT = 12522


class AngleUnits(Enum):
    """Of an encoder."""

    DEGREES = 10146
    RADIANS = 10273
    FROM_CUSTOM_SCALE = 10065
    TICKS = 10304


class DigitalWidthUnits(Enum):
    """Of a delay."""

    SAMPLE_CLOCK_PERIODS = 10286
    SECONDS = 10364
    TICKS = 10304


class Edge(Enum):
    """Of a clock."""

    RISING = 10280
    FALLING = 10171


class EncoderType(Enum):
    """Counts for each cycle."""

    X_1 = 10090
    X_2 = 10091
    X_4 = 10092
    TWO_PULSE_COUNTING = 10313


class EncoderZIndexPhase(Enum):
    """Where the index resets the count."""

    AHIGH_BHIGH = 10040
    AHIGH_BLOW = 10041
    ALOW_BHIGH = 10042
    ALOW_BLOW = 10043


class RegenerationMode(Enum):
    """Whether samples are put out again."""

    ALLOW_REGENERATION = 10097
    DONT_ALLOW_REGENERATION = 10158


class TaskMode(Enum):
    """States that a task can be asked to be in."""

    TASK_START = 0
    TASK_STOP = 1
    TASK_VERIFY = 2
    TASK_COMMIT = 3
    TASK_RESERVE = 4
    TASK_UNRESERVE = 5
    TASK_ABORT = 6


class TerminalConfiguration(Enum):
    """Wiring of an analog input."""

    RSE = 10083
    NRSE = 10078
    DIFF = 10106
    PSEUDO_DIFF = 12529
    DEFAULT = -1


class VoltageUnits(Enum):
    """Of an analog channel."""

    VOLTS = 10348
    FROM_CUSTOM_SCALE = 10065
    FROM_TEDS = 12516


class WatchdogAOExpirState(Enum):
    """What an expiration state is."""

    VOLTAGE = 10322
    CURRENT = 10134
    NO_CHANGE = 10160
