"""What a run will do, checked against the rig's limits before anything is energised."""

import numpy as np

from daq.config.rig import RigConfig
from daq.errors import ConfigError
from daq.experiment import ClosedLoop, Experiment, Plan
from daq.hal import CHANNELS, FloatArray
from daq.limits.load import i2t_levels
from daq.run.protocol import description_of, plan_of, rehearse

_ROUNDING = 1.0 + 1e-9


def plan(experiment: Experiment, rig: RigConfig) -> Plan:
    """What a run will do.

    Raises ConfigError, naming the key, for settings that make no run, and for a plan that breaks
    one of the rig's limits: the sample and the value, as far as they are known beforehand.
    """
    planned = plan_of(experiment)
    description_of(experiment)
    if isinstance(experiment, ClosedLoop):
        rehearse(experiment, planned)
    _check_homing(experiment.homing.turns, rig)
    check_commands(planned, experiment.sample_rate, rig)
    if isinstance(experiment, ClosedLoop) and rig.limits.speed is not None:
        for name, values in planned.references.items():
            if experiment.columns.get(name) == "rad/s":
                _check_speed(values, rig.limits.speed, name)
    return planned


def check_commands(planned: Plan, sample_rate: float, rig: RigConfig) -> None:
    """Raise ConfigError for commands beyond a rig's ranges, slew, current or i^2 t."""
    for channel, name in enumerate(CHANNELS):
        _check_range(planned, rig, channel, name)
        if planned.commands is not None:
            volts = planned.commands[:, channel]
            _check_slew(volts, sample_rate, rig, name)
            _check_current(volts, sample_rate, rig, name)


def _check_homing(turns: float, rig: RigConfig) -> None:
    least, travel = rig.limits.winding, rig.limits.travel
    if turns > 0.0 and least is not None and turns <= least:
        limit = f"limits.winding of the rig's file wants {least:g} left"
        problem = f"{turns:g} turns are wound, and {limit}"
        raise ConfigError(problem, cure="wind more", key="homing.turns")
    if travel is not None and turns > max(-travel[0], travel[1]):
        raise ConfigError(
            f"{turns:g} turns are outside limits.travel of the rig's file, "
            f"[{travel[0]:g}, {travel[1]:g}] turns",
            cure="wind less",
            key="homing.turns",
        )


def _check_range(planned: Plan, rig: RigConfig, channel: int, name: str) -> None:
    least, most = getattr(rig.limits.command, name)
    low, high = planned.lowest[channel], planned.highest[channel]
    if low >= least and high <= most:
        return
    beyond, where = (high, np.argmax) if high > most else (low, np.argmin)
    request = f"up to {beyond:.6g} V"
    if planned.commands is not None:
        request = f"for {beyond:.6g} V in sample {where(planned.commands[:, channel])}"
    raise ConfigError(
        f"the plan asks {request}, outside the rig's limits [{least:g}, {most:g}] V",
        cure=f"change amplitude or offset, or limits.command.{name} in the rig's file if the "
        "hardware allows it",
        key=name,
    )


def _check_slew(volts: FloatArray, rate: float, rig: RigConfig, name: str) -> None:
    limit = getattr(rig.limits.slew, name)
    if limit is None:
        return
    slopes = np.abs(np.diff(volts, prepend=0.0)) * rate
    row = int(np.argmax(slopes))
    if not slopes[row] <= limit * _ROUNDING:
        raise ConfigError(
            f"the plan changes the command at {slopes[row]:.6g} V/s in sample {row} (from "
            f"{volts[row - 1] if row else 0.0:.6g} V to {volts[row]:.6g} V), faster than the rig's "
            f"limit of {limit:g} V/s",
            cure=f"make smaller or slower steps, or change limits.slew.{name} in the rig's file if "
            "the hardware allows it",
            key=name,
        )


def _check_current(volts: FloatArray, rate: float, rig: RigConfig, name: str) -> None:
    """Current and i^2 t, where the amplifier's gain tells them; what flows in fact is less."""
    gain = getattr(rig.amplifiers, name)
    if gain is None:
        return
    current, most = np.abs(volts) * gain, getattr(rig.limits.current, name)
    row = int(np.argmax(current))
    if current[row] > most * _ROUNDING:
        raise ConfigError(
            f"the plan asks for {volts[row]:.6g} V in sample {row}, which is {current[row]:.4g} A "
            f"by amplifiers.{name}, beyond limits.current.{name} of {most:g} A",
            cure="change amplitude or offset",
            key=name,
        )
    load = getattr(rig.limits.i2t, name)
    if load is None:
        return
    levels = i2t_levels(0.0, current, np.full(len(current), 1.0 / rate), load.continuous)
    beyond = levels > load.budget
    if beyond.any():
        row = int(np.argmax(beyond))
        raise ConfigError(
            f"by sample {row} ({row / rate:.4g} s) the plan has reached {levels[row]:.4g} A^2*s "
            f"above {load.continuous:g} A, beyond the budget of limits.i2t.{name}, "
            f"{load.budget:g} A^2*s",
            cure="make it shorter or smaller, or pause for the winding to cool down",
            key=name,
        )


def _check_speed(values: FloatArray, limit: float, name: str) -> None:
    row = int(np.argmax(np.abs(values)))
    if not abs(values[row]) <= limit * _ROUNDING:
        raise ConfigError(
            f"the plan asks for {values[row]:.4g} rad/s in sample {row}, beyond limits.speed of "
            f"{limit:g} rad/s",
            cure="ask for less, or change limits.speed in the rig's file if the hardware allows it",
            key=name,
        )
