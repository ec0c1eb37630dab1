"""Gain, offset and drift of a model's channels, as parameters that are identified with its own."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from sysid.problem.extension import extended
from sysid.problem.model import Function, ModelError, Parameter, ProcessModel, State, picker

Kind = Literal["gain", "offset", "drift"]

# Time since a record's first sample, a state of models whose channels drift.
_CLOCK = State("time_of_record", "s", first_sample=False)


@dataclass(frozen=True)
class Correction:
    """What is wrong with a channel: its gain, by which it is to be multiplied, offset, or drift.

    Of an output the model's value is multiplied, or the offset added to it, before it is compared
    with what was measured; of an input what was measured, before the model takes it. A channel that
    is both is corrected as both. A drift is an offset that grows with the time since a record's
    first sample. low, high: range of the parameter, with what means no error in it; of an offset in
    the channel's unit, of a drift in that per second.

    >>> Correction("torque", "gain", 0.5, 2.0).parameter
    'gain_of_torque'
    """

    channel: str
    kind: Kind
    low: float
    high: float

    @property
    def parameter(self) -> str:
        """Name of its parameter."""
        return f"{self.kind}_of_{self.channel}"


def with_corrections(model: ProcessModel, corrections: Sequence[Correction]) -> ProcessModel:
    """The model with the gains, offsets and drifts of channels as parameters behind its own.

    Raises ModelError for a channel that it has not, a bad range, or a name that it has already.

    >>> from sysid.examples import lag
    >>> measured = with_corrections(lag(), [Correction("y", "gain", 0.5, 2.0)])
    >>> measured.parameter_names, measured.output((3.0,), (0.0,), (2.0, 0.5, 1.5))
    (('gain', 'tau', 'gain_of_y'), (4.5,))
    """
    for correction in corrections:
        model = _with_correction(model, correction)
    return model


def _with_correction(model: ProcessModel, correction: Correction) -> ProcessModel:
    channel, neutral = correction.channel, 1.0 if correction.kind == "gain" else 0.0
    drifts = correction.kind == "drift"
    units = {s.name: s.unit for s in model.inputs} | {s.name: s.unit for s in model.outputs}
    if channel not in units:
        there = ", ".join(units)
        raise ModelError(f"model {model.name} has no channel {channel!r}; it has {there}")
    if not correction.low <= neutral <= correction.high:
        raise ModelError(
            f"the range of {correction.parameter}, {correction.low:g} to {correction.high:g}, does "
            f"not hold {neutral:g}, which means no error"
        )
    parameter = Parameter(
        correction.parameter,
        {"gain": "1", "offset": units[channel], "drift": f"{units[channel]}/s"}[correction.kind],
        neutral,
        correction.low,
        correction.high,
        minimum=-math.inf,
        description=f"{correction.kind} of the channel {channel}",
        corrects=channel,
    )
    model = _timed(model) if drifts else model
    n, derivative, output = len(model.parameters), model.derivative, _output_of(model)
    clock = model.state_names.index(_CLOCK.name) if drifts else 0
    taken = _corrected(model.input_names, correction)
    given = _corrected(model.output_names, correction)
    sign, times = "*" if correction.kind == "gain" else "+", " * t" if drifts else ""

    def size(x: Any, p: Any) -> Any:
        return p[n] * x[clock] if drifts else p[n]

    return extended(
        model,
        parameter,
        lambda x, u, p: derivative(x, taken(u, size(x, p)), p[:n]),
        lambda x, u, p: given(output(x, taken(u, size(x, p)), p[:n]), size(x, p)),
        f"{channel} {sign} {correction.parameter}{times}",
        lambda variant: _with_correction(variant, correction),
    )


def _timed(model: ProcessModel) -> ProcessModel:
    """The model with the time since a record's first sample as its last state."""
    if _CLOCK.name in model.state_names:
        return model
    n, derivative, output = len(model.states), model.derivative, model.output
    return replace(
        model,
        states=(*model.states, _CLOCK),
        derivative=lambda x, u, p: (*derivative(x[:n], u, p), 1.0),
        output=None if output is None else lambda x, u, p: output(x[:n], u, p),
    )


def _output_of(model: ProcessModel) -> Function:
    """The model's output function, or the one that picks its states."""
    if model.output is not None:
        return model.output
    pick = picker([model.state_names.index(name) for name in model.output_names])
    return lambda x, u, p: pick(x)


def _corrected(
    names: Sequence[str], correction: Correction
) -> Callable[[Any, Any], tuple[Any, ...]]:
    """A function of signals of these names, and of the parameter, that corrects the channel."""
    if correction.channel not in names:
        return lambda values, _: tuple(values)
    place = names.index(correction.channel)
    if correction.kind == "gain":
        return lambda values, a: (*values[:place], values[place] * a, *values[place + 1 :])
    return lambda values, a: (*values[:place], values[place] + a, *values[place + 1 :])
