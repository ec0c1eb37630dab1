"""Gain and offset of a model's channels, as parameters that are identified with its own."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sysid.problem.extension import extended
from sysid.problem.model import Function, ModelError, Parameter, ProcessModel, picker

Kind = Literal["gain", "offset"]


@dataclass(frozen=True)
class Correction:
    """What is wrong with a channel: its gain, by which it is to be multiplied, or its offset.

    Of an output the model's value is multiplied, or the offset added to it, before it is compared
    with what was measured; of an input what was measured, before the model takes it. A channel that
    is both is corrected as both. low, high: range of the parameter, with what means no error in it;
    of an offset in the channel's unit.

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
    """The model with the gains and offsets of channels as parameters behind its own.

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
        "1" if correction.kind == "gain" else units[channel],
        neutral,
        correction.low,
        correction.high,
        minimum=-math.inf,
        description=f"{correction.kind} of the channel {channel}",
        corrects=channel,
    )
    n, derivative, output = len(model.parameters), model.derivative, _output_of(model)
    taken = _corrected(model.input_names, correction)
    given = _corrected(model.output_names, correction)
    sign = "*" if correction.kind == "gain" else "+"
    return extended(
        model,
        parameter,
        lambda x, u, p: derivative(x, taken(u, p[n]), p[:n]),
        lambda x, u, p: given(output(x, taken(u, p[n]), p[:n]), p[n]),
        f"{channel} {sign} {correction.parameter}",
        lambda variant: _with_correction(variant, correction),
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
