"""The figure of a design."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from daq.config.rig import RigConfig
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
    commands = np.concatenate([run.commands for run in runs])
    ends = np.cumsum([len(run.commands) * run.dt for run in runs])
    time: FloatArray = np.arange(len(commands), dtype=np.float64) * runs[0].dt
    predictions = []
    for j, name in enumerate(CHANNELS):
        line = commands[:, j]
        limits = getattr(rig.limits.command, name)
        title = f"cmd_voltage_{name}"
        predictions.append(Prediction(title, "V", line, line, line, limits, steps=True))
    for name, limits in _limits_of(rig).items():
        if name in runs[0].signals:
            values = np.concatenate([run.signals[name] for run in runs], axis=1)
            predictions.append(_prediction(name, values, limits))
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
        name: (None if most is None else -most, most) for name, most in both.items()
    }
    low = limits.winding if limits.winding is not None else travel[0]
    ends["theta"] = _in_radians(low), _in_radians(travel[1])
    return ends


def _in_radians(turns: float | None) -> float | None:
    return None if turns is None else turns * TURN


def _prediction(name: str, values: FloatArray, limits: _Limits) -> Prediction:
    return Prediction(name, UNITS[name], values[0], values.min(axis=0), values.max(axis=0), limits)
