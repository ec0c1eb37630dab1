"""Asking a protocol, whose code may be anybody's: its answers are checked, its mistakes placed."""

import contextlib
import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, raised_in
from daq.experiment import (
    MOST_SAMPLES,
    Answer,
    ClosedLoop,
    Controller,
    Experiment,
    Plan,
    Sample,
    SettingError,
)
from daq.findings import Chart, Heatmap
from daq.hal import CHANNELS

_ROUNDING = 1e-9  # of a plan's bounds


def failure(experiment: Experiment, doing: str, error: BaseException) -> str:
    """The sentence on an error in a protocol's code: which, where, what."""
    return (
        f"the protocol {experiment.protocol!r} failed {doing}: {type(error).__name__}: {error}"
        f"{raised_in(type(experiment), error)}"
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


def controller_of(experiment: ClosedLoop) -> Controller:
    """A new controller. Raises ConfigError."""
    with _before_the_run(experiment, "in controller()"):
        controller = experiment.controller()
        if not callable(getattr(controller, "answer", None)):
            raise TypeError(
                f"it returned {controller!r}; return an object with a method answer(sample)"
            )
    return controller


def rehearse(experiment: ClosedLoop, planned: Plan) -> None:
    """Ask a controller of its own for its first answer, to a shaft at rest.

    Most mistakes in one show there. Raises ConfigError.
    """
    controller = controller_of(experiment)
    with _before_the_run(experiment, "when asked for its first answer, at rest"):
        answer = controller.answer(Sample(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0))
        if answer is not None:
            AnswerCheck(experiment, planned)(answer)


class AnswerCheck:
    """Whether an answer is one, and within the plan; made once for a run, as it is asked often."""

    def __init__(self, experiment: ClosedLoop, planned: Plan) -> None:
        self._plan = planned
        self._columns = tuple(experiment.columns)
        reach = _ROUNDING * np.max(np.abs([planned.lowest, planned.highest]), axis=0)
        ends = np.stack([planned.lowest - reach, planned.highest + reach], axis=1)
        self._bounds: list[list[float]] = ends.tolist()

    def __call__(self, answer: Answer) -> None:
        """Raises TypeError or ValueError."""
        if not isinstance(answer, Answer):
            raise TypeError(f"it answered {answer!r}; answer with a daq.experiment.Answer or None")
        (motor_low, motor_high), (brake_low, brake_high) = self._bounds
        if not (
            motor_low <= answer.motor <= motor_high and brake_low <= answer.brake <= brake_high
        ):
            (motor_low, brake_low), (motor_high, brake_high) = self._plan.lowest, self._plan.highest
            raise ValueError(
                f"it answered motor {answer.motor!r} V, brake {answer.brake!r} V, and its plan "
                f"says {motor_low:g} to {motor_high:g} V and {brake_low:g} to {brake_high:g} V"
            )
        if len(answer.logged) != len(self._columns) or not all(map(math.isfinite, answer.logged)):
            raise ValueError(
                f"it logged {answer.logged!r}; a finite number for each of its columns is "
                f"expected: {', '.join(self._columns) or 'none'}"
            )


def preview_of(experiment: ClosedLoop) -> Chart | Heatmap | None:
    """What a protocol draws beforehand. Raises ConfigError."""
    with _before_the_run(experiment, "in preview()"):
        return experiment.preview()


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
