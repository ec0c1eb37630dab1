"""What every experiment's YAML has in common; each protocol adds its own keys."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.hal import FloatArray

_MAX_SAMPLES = 20_000_000


class OffsetCalibration(Section):
    """Mean of the analog inputs at zero command, taken off all later samples."""

    samples: int = Field(3200, ge=1, le=1_000_000, description="samples averaged")


class Homing(Section):
    """Winding of the load's cable before the run."""

    turns: float = Field(0.0, ge=0.0, le=1000.0, description="turns to wind; 0 skips homing")
    timeout: float = Field(60.0, gt=0.0, le=3600.0, description="time allowed for it [s]")


class Experiment(Section, abc.ABC):
    """An experiment: common settings here, a protocol's own in its subclass.

    A protocol is a subclass with further fields and a ``waveform``, registered under the
    entry-point group ``rig.protocols``.
    """

    name: str = Field("", max_length=80, description="of the capture folder; default the file's")
    protocol: str = Field(min_length=1, description="name of an installed protocol")
    sample_rate: float = Field(800.0, gt=0.0, le=1e6, description="samples per second [Hz]")
    duration: float = Field(gt=0.0, le=86400.0, description="length of the excitation [s]")
    calibration: OffsetCalibration = Field(OffsetCalibration(), description="offset calibration")
    homing: Homing = Field(Homing(), description="winding of the load")
    validation: dict[str, Any] = Field(
        default_factory=dict,
        description="keys that differ in the validation run of rig run --identify",
    )

    @property
    def n_samples(self) -> int:
        """Number of samples, the nearest to duration * sample_rate."""
        return round(self.duration * self.sample_rate)

    def check_length(self) -> None:
        """Raise ValueError unless the run has a sensible number of samples."""
        if not 2 <= self.n_samples <= _MAX_SAMPLES:
            raise ValueError(
                f"duration: {self.duration:g} s at {self.sample_rate:g} Hz makes "
                f"{self.n_samples} samples; 2 to {_MAX_SAMPLES} are possible: "
                "change duration or sample_rate"
            )

    @abc.abstractmethod
    def waveform(self) -> FloatArray:
        """Commands of the whole run, (n_samples, 2): motor and brake [V].

        Raises ValueError, naming key and cure, for settings that make no waveform.
        """

    def describe(self) -> dict[str, Any]:
        """The experiment as resolved, for run.json."""
        return self.model_dump(mode="json")


def peaks(waveform: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest command of each channel, (2,) each [V]."""
    return np.min(waveform, axis=0), np.max(waveform, axis=0)
