"""Asking a protocol, whose code may be anybody's: its answers are checked, its mistakes placed."""

import contextlib
import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError, nearby, raised_in
from daq.experiment import (
    MOST_SAMPLES,
    Aboard,
    Answer,
    ClosedLoop,
    Evidence,
    Experiment,
    Plan,
    Sample,
    SettingError,
    TripLimits,
)
from daq.findings import Chart, Heatmap
from daq.hal import CHANNELS, FloatArray, Samples
from daq.progress import Watch

_ROUNDING = 1e-9  # of a plan's bounds


def failure(experiment: Experiment, doing: str, error: BaseException) -> str:
    """The sentence on an error in a protocol's code: which, where, what."""
    return (
        f"the protocol {nearby(experiment.protocol)!r} failed {doing}: {type(error).__name__}: "
        f"{error}{raised_in(type(experiment), error)}"
    )


def plan_of(experiment: Experiment) -> Plan:
    """What a protocol plans. Raises ConfigError for settings that make no run, or its mistakes."""
    with _before_the_run(experiment, "in plan()"):
        try:
            planned = experiment.plan()
        except ValueError as error:
            raise _refused(experiment, error) from None
        _check_form(planned, experiment)
    return planned


def _refused(experiment: Experiment, error: ValueError) -> ConfigError:
    """What a protocol says of its settings, by the key that its text begins with."""
    if isinstance(error, SettingError):
        key, problem = error.key, error.problem
    else:
        # The convention for protocols of users: the one place where a text is taken apart.
        begin = re.match(r"([\w.]+): ", str(error))
        key, problem = (begin[1], str(error)[begin.end() :]) if begin else ("", str(error))
    return ConfigError(f"{problem}{raised_in(type(experiment), error)}", key=key)


def description_of(experiment: Experiment) -> dict[str, Any]:
    """What a protocol says of itself, of types that JSON has. Raises ConfigError."""
    with _before_the_run(experiment, "in describe()"):
        described: dict[str, Any] = json.loads(json.dumps(experiment.describe(), default=_plain))
    return described


def rehearse(experiment: ClosedLoop, planned: Plan) -> None:
    """Ask a new controller for its first answer, where most mistakes show. Raises ConfigError."""
    dialogue = Dialogue(experiment, planned)
    with _before_the_run(experiment, "when asked for its first answer, at rest"):
        dialogue.answer(Sample(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0))


class Dialogue:
    """A protocol's new controller, asked for one sample after the other.

    ahead: ticks from a sample to its command. ended: whether it has given its last answer. Raises
    ConfigError where no controller can be made.
    """

    def __init__(self, experiment: ClosedLoop, planned: Plan) -> None:
        self.ahead = experiment.ahead
        self.ended = False
        self._experiment = experiment
        self._plan = planned
        self._columns = tuple(experiment.columns)
        self._logged = (0.0,) * len(self._columns)  # with the last answer
        reach = _ROUNDING * np.max(np.abs([planned.lowest, planned.highest]), axis=0)
        ends = np.stack([planned.lowest - reach, planned.highest + reach], axis=1)
        self._bounds: list[list[float]] = ends.tolist()
        with _before_the_run(experiment, "in controller()"):
            self._controller = experiment.controller()
            if not callable(getattr(self._controller, "answer", None)):
                raise TypeError(
                    f"it returned {self._controller!r}; return an object with a method "
                    "answer(sample)"
                )

    def answers(self, samples: Samples) -> tuple[FloatArray, list[FloatArray]]:
        """Commands (n, 2) [V] that answer a block of samples, and the columns it logs, (n,) each.

        Zero commands are the last where it ends. Raises RunError for the protocol's mistakes.
        """
        rows: list[Answer] = []
        columns = [getattr(samples, name).tolist() for name in Sample._fields]
        for values in zip(*columns, strict=True):
            sample = Sample(*values)
            try:
                answer = self.answer(sample)
            except RigError:
                raise
            except USER_CODE_ERRORS as error:
                raise self._failed(sample.tick, error) from error
            self.ended = answer is None
            rows.append(answer or Answer(0.0, 0.0, self._logged))
            if self.ended:
                break
            self._logged = rows[-1].logged
        try:
            commands = np.array([(row.motor, row.brake) for row in rows], dtype=np.float64)
            logged = np.array([row.logged for row in rows], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise self._failed(samples.tick.item(0), error) from error
        return commands, list(logged.reshape(len(rows), len(self._columns)).T)

    def answer(self, sample: Sample) -> Answer | None:
        """The answer to a sample. Raises TypeError or ValueError for one beyond the plan."""
        answer = self._controller.answer(sample)
        if answer is None:
            return None
        if not isinstance(answer, Answer):
            raise TypeError(f"it answered {answer!r}; answer with a daq.experiment.Answer or None")
        (motor_low, motor_high), (brake_low, brake_high) = self._bounds
        if not (
            motor_low <= answer.motor <= motor_high and brake_low <= answer.brake <= brake_high
        ):
            # With 0.0 added a zero has no minus before it.
            (motor_low, brake_low) = np.asarray(self._plan.lowest) + 0.0
            (motor_high, brake_high) = np.asarray(self._plan.highest) + 0.0
            raise ValueError(
                f"it answered motor {answer.motor!r} V, brake {answer.brake!r} V, and its plan "
                f"says {motor_low:g} to {motor_high:g} V and {brake_low:g} to {brake_high:g} V"
            )
        if len(answer.logged) != len(self._columns) or not all(map(math.isfinite, answer.logged)):
            raise ValueError(
                f"it logged {answer.logged!r}; a finite number for each of its columns is "
                f"expected: {', '.join(self._columns) or 'none'}"
            )
        return answer

    def _failed(self, tick: int, error: BaseException) -> RunError:
        text = failure(self._experiment, f"at sample {tick}", error)
        return RunError(text)


def preview_of(experiment: Experiment) -> Chart | Heatmap | None:
    """What a protocol draws beforehand, if it has a closed loop. Raises ConfigError."""
    with _before_the_run(experiment, "in preview()"):
        return experiment.preview() if isinstance(experiment, ClosedLoop) else None


def aboard_of(experiment: Experiment) -> Aboard | None:
    """What a protocol asks of the device's own controller, if it does. Raises ConfigError."""
    with _before_the_run(experiment, "in aboard()"):
        return experiment.aboard() if isinstance(experiment, ClosedLoop) else None


def evidence_of(
    experiment: ClosedLoop, limits: TripLimits, draws: int, watch: Watch
) -> Evidence | None:
    """What a protocol's trials say beforehand. Raises ConfigError."""
    with _before_the_run(experiment, "in evidence()"):
        return experiment.evidence(limits, draws, watch)


@contextlib.contextmanager
def _before_the_run(experiment: Experiment, doing: str) -> Iterator[None]:
    try:
        yield
    except RigError:
        raise
    except USER_CODE_ERRORS as error:
        raise ConfigError(failure(experiment, doing, error)) from error


def _plain(value: Any) -> Any:
    """Arrays and numbers of numpy as lists and numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} is of no type that JSON has")


def _check_form(planned: Any, experiment: Experiment) -> None:
    """TypeError unless it is a plan whose parts fit each other."""
    if not isinstance(planned, Plan):
        raise TypeError(f"it returned {planned!r}; return a daq.experiment.Plan")
    n = planned.n_samples
    if not isinstance(n, int | np.integer) or not 2 <= n <= MOST_SAMPLES:
        raise TypeError(f"n_samples is {n!r}; a whole number from 2 to {MOST_SAMPLES} is possible")
    for name in ("lowest", "highest"):
        _require(name, getattr(planned, name), (len(CHANNELS),), "one for each channel, in volts")
    if np.any(np.greater(planned.lowest, planned.highest)):
        raise TypeError(f"lowest, {planned.lowest}, is above highest, {planned.highest}")
    if isinstance(experiment, ClosedLoop) == (planned.commands is not None):
        raise TypeError("commands belong to a protocol in open loop, and only there")
    if planned.commands is not None:
        _require("commands", planned.commands, (n, len(CHANNELS)), "in volts")
    for name, values in planned.references.items():
        m = min(n, max(map(len, planned.references.values())))
        _require(f"references[{name!r}]", values, (m,), "as many as the others, n_samples at most")
    if isinstance(planned.remarks, str):
        raise TypeError("remarks is a text; write a tuple of texts, a line each: ('...',)")


def _require(name: str, values: Any, shape: tuple[int, ...], what: str) -> None:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise TypeError(
            f"{name} is of shape {array.shape} and type {array.dtype}; expected {shape}: {what}"
        )
