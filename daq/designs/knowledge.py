"""What is known before a design: parameters with their covariance, and noise of the sensors."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from daq.config.rig import RigConfig
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError
from daq.hal import ANALOG_INPUTS, FloatArray
from daq.identification import stages
from daq.logs.encoder import SPEED, repeated
from daq.logs.recording import Recording
from sysid import ProcessModel, SearchSpace
from sysid.experiments import Prior

_VOLTS = 0.010  # rms at an analog input, where nothing tells more
_COUNTS = 1.0 / 6.0  # of the count in a sample, by which a speed errs
_TIMED = 0.03  # of that, beside what the instants of its edges do
# To what a log tells how long the last edge was ago: in parts of the time between edges, and at
# most of a sample; of a sample where some have no edge.
_INTERVAL, _WAIT, _LONE = 0.6, 0.2, 0.05
_NEVER = 1e3  # s, by which a sample may be off that tells of no time


def prior_of(space: SearchSpace, file: YamlFile | None) -> Prior:
    """What the ranges say, and beside them an earlier identification's result.

    Of what the result had fixed, or found at an end of its range, the value alone is taken: how
    well that holds the ranges say. file: the result. Raises ConfigError for one of another model,
    or without numbers.
    """
    ranges = Prior.of_ranges(space)
    if file is None:
        return ranges
    model, n_free = space.model, len(space.index)
    names = [name for name in space.names[:n_free] if name in file.content["parameters"]]
    if not names:
        problem = f"it has no parameter of model {model.name} that is searched"
        raise file.error(("parameters",), problem, "name a result of the same model")
    values = ranges.values.copy()
    for name in names:
        values[space.names.index(name)] = stages.value(file, name, model)
    values = np.clip(values, space.lower, space.upper)
    columns = file.content["covariance"].get("parameters")
    searched = [n for n in names if not isinstance(columns, list) or n in columns]
    rows = stages.factor(file, searched, model)
    changes = np.zeros((len(rows), n_free))
    changes[:, [space.names.index(name) for name in searched]] = np.reshape(
        rows, (-1, len(searched))
    )
    changes /= np.where(space.log, values, 1.0)
    places = np.flatnonzero(np.any(changes != 0.0, axis=0)).tolist()
    entries = file.content["parameters"]
    tied = [
        place
        for place in places
        if isinstance(entry := entries[space.names[place]], dict)
        if entry.get("undetermined") == "tied"
    ]
    return _together(space, ranges, Prior(values, changes.T @ changes), places, tied)


def _together(
    space: SearchSpace, ranges: Prior, result: Prior, places: list[int], tied: list[int]
) -> Prior:
    """What ranges and a result say together: their normal distributions' product.

    places: the coordinates that the result knows. tied: those of what acts only with others, whose
    values stay: any are as good, and a straight way to others does not keep sums of them.
    """
    block = np.ix_(places, places)
    widths, of_result = ranges.covariance[block], result.covariance[block]
    # Neither is inverted: a result tells some things next to exactly, others hardly at all.
    share = np.linalg.solve(widths + of_result, of_result).T
    covariance = ranges.covariance.copy()
    covariance[block] = share @ widths
    covariance = 0.5 * (covariance + covariance.T)
    away = space.encode(ranges.values) - space.encode(result.values)
    offset = np.zeros(len(away))
    offset[places] = share @ away[places]
    offset[tied] = 0.0
    moved = space.decode(space.encode(result.values) + offset)
    values = np.clip(moved, space.lower, space.upper)
    return Prior(values if space.feasible(values) else result.values, covariance)


def noise_of(
    file: YamlFile,
    given: Mapping[str, float],
    rig: RigConfig,
    model: ProcessModel,
    sample_rate: float,
    log: Recording | None,
) -> dict[str, float]:
    """Standard deviation of each measured output and input of a model.

    given: by name, from ``file``, before what the calibration of a log tells and what is assumed.
    Raises ConfigError for a name that is not measured, or of which nothing is known.
    """
    measured = [
        *model.output_names,
        *(name for name in model.input_names if not name.startswith("applied_")),
    ]
    for name in given:
        if name not in measured:
            problem = f"model {model.name} measures no {name}; it measures {', '.join(measured)}"
            raise file.error(("noise", name), problem)
    assumed = _assumed(rig, sample_rate)
    noise = {}
    for name in measured:
        calibrated = log.noise(name)[0] if log is not None else 0.0
        deviation = given.get(name) or calibrated or assumed.get(name)
        if deviation is None:
            cure = f"write its standard deviation, noise: {{{name}: ...}}"
            raise file.error(("noise",), f"nothing tells the noise of {name}", cure)
        noise[name] = deviation
    return noise


def _assumed(rig: RigConfig, sample_rate: float) -> dict[str, float]:
    """Noise of a rig's signals by its sensors' scales and its encoder's counts."""
    sensors = rig.sensors
    count = abs(sensors.encoder.count)
    analog = {name: _VOLTS * getattr(sensors, name).scale for name in ANALOG_INPUTS}
    omega = _TIMED * speed_noise(rig, sample_rate)
    return {**analog, "theta": count / math.sqrt(12.0), SPEED: omega}


def speed_noise(rig: RigConfig, sample_rate: float) -> float:
    """Standard deviation of a speed by its encoder's counts in a sample [rad/s]."""
    return _COUNTS * abs(rig.sensors.encoder.count) * sample_rate


def expected_jitter(omega: FloatArray, dt: float, count: float) -> FloatArray:
    """Standard deviations of when speeds were measured that are timed from edge to edge [s].

    As ``daq.logs.encoder.mean_speeds`` finds them in a log on average; where it finds no speed, so
    long that the sample tells nothing. omega: (n,) [rad/s]; count: angle of one [rad].

    >>> (1e3 * expected_jitter(np.array([0.1, 1.0, 10.0, 1.0]), 1e-3, 1e-3)).round(4).tolist()
    [0.0144, 0.0577, 0.0173, 0.0577]
    """
    length = count / np.maximum(np.abs(omega) * dt, 1e-3 * count)  # samples between edges
    wait = np.where(length > 1.0, _LONE, np.minimum(_INTERVAL * length, _WAIT))
    jitter = dt * wait / math.sqrt(12.0)
    return np.where(_between_turns(omega * (dt / count)), _NEVER, jitter)


def _between_turns(rate: FloatArray) -> npt.NDArray[np.bool_]:
    """At which samples the last edges are such between which the shaft turned round repeatedly.

    rate: (n,), in counts a sample.
    """
    steps = np.diff(np.floor(np.cumsum(rate)), prepend=0.0)
    rows = np.flatnonzero(steps)
    turned = np.zeros(len(rows) + 1, dtype=bool)
    turned[1:-1] = steps[rows[1:]] * steps[rows[:-1]] < 0.0
    return repeated(turned)[np.searchsorted(rows, np.arange(len(rate)))]


def require_calibrated(path: Path, log: Recording) -> None:
    """Raise ConfigError for a log whose run was not calibrated."""
    if not (log.record or {}).get("calibration", {}).get("noise"):
        problem = "it has no calibration, which tells the noise of the sensors"
        raise ConfigError(problem, cure="name the folder of a run that rig run made", file=path)
