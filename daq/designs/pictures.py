"""The figure of a design."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from daq.config.rig import RigConfig
from daq.designs.bench import COMMANDED
from daq.designs.result import DesignResult, PlannedRun
from daq.figures import design as figures
from daq.figures import style
from daq.figures.design import Prediction
from daq.files import write_whole
from daq.hal import CHANNELS, FloatArray
from daq.limits.base import TURN
from daq.logs.columns import UNITS

_Limits = tuple[float | None, float | None]
Widths = tuple[float, float, float | None]


def draw_design(result: DesignResult, rig: RigConfig) -> None:
    """Draw a design into its file. Raises RunError where the disk refuses."""
    intervals = {
        q.name: (100.0 * q.before, 100.0 * q.after, None if q.target is None else 100.0 * q.target)
        for q in result.design.quantities
    }
    draw_runs(result.runs, rig, intervals, result.figure)


def draw_runs(
    runs: Sequence[PlannedRun], rig: RigConfig, intervals: Mapping[str, Widths], path: Path
) -> None:
    """Draw what runs do into a file, and below it intervals if there are any.

    intervals: half widths before and after, and what is wanted, by quantity [%]. Raises RunError
    where the disk refuses.
    """
    signals = {
        name: np.concatenate([run.signals[name] for run in runs], axis=1)
        for name in runs[0].signals
    }
    ends = np.cumsum([run.seconds for run in runs])
    time: FloatArray = np.arange(len(signals["omega"][0]), dtype=np.float64) * runs[0].dt
    predictions = [
        _prediction(name, signals[name], limits)
        for name, limits in _limits_of(rig).items()
        if name in signals
    ]
    figure = figures.design(time, ends[:-1].tolist(), predictions, intervals)
    write_whole(path, style.render(figure, style.format_of(path)))


def _limits_of(rig: RigConfig) -> dict[str, _Limits]:
    """Limits of the signals that a design may reach, by name."""
    limits, travel = rig.limits, rig.limits.travel or (None, None)
    both = {
        "current_motor": limits.current.motor,
        "current_brake": limits.current.brake,
        "torque": limits.torque,
        "omega": limits.speed,
    }
    ends: dict[str, _Limits] = {
        name: getattr(limits.command, channel)
        for name, channel in zip(COMMANDED, CHANNELS, strict=True)
    }
    ends |= {name: (None if most is None else -most, most) for name, most in both.items()}
    low = limits.winding if limits.winding is not None else travel[0]
    ends["theta"] = _in_radians(low), _in_radians(travel[1])
    return ends


def _in_radians(turns: float | None) -> float | None:
    return None if turns is None else turns * TURN


def _prediction(name: str, values: FloatArray, limits: _Limits) -> Prediction:
    lowest, highest = values.min(axis=0), values.max(axis=0)
    steps = name in COMMANDED
    return Prediction(name, UNITS[name], values[0], lowest, highest, limits, steps=steps)
