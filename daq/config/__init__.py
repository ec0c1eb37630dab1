"""Configuration files: typed, with errors that point at the line."""

from daq.config.experiment import Experiment, Homing, OffsetCalibration
from daq.config.rig import RigConfig

__all__ = ["Experiment", "Homing", "OffsetCalibration", "RigConfig"]
