"""Where a parameter is searched, and which parameters follow others."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from sysid.problem.model import ModelError, Parameter, ProcessModel, Scale, check_range

# (low, high), either of which may be None: then only the other is a bound.
Range = tuple[float | None, float | None]

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TIE = re.compile(
    rf"(?P<sign>[-+])?\s*(?:(?P<before>{_NUMBER})\s*\*\s*)?(?P<name>[^\W\d]\w*)\s*"
    rf"(?:(?P<sign_behind>[*/])\s*(?P<behind>{_NUMBER}))?"
)
_DECADE = 10.0


@dataclass(frozen=True)
class Tie:
    """Parameter ``index`` is ``factor`` times parameter ``source``, which is not tied itself."""

    index: int
    source: int
    factor: float


def with_search_range(parameter: Parameter, given: Range | None, scale: Scale | None) -> Parameter:
    """The parameter with the range and scale that it is searched in.

    given: in place of the declared range. With one end left out the other is a physical limit,
    and the search starts between it and the far end of the declared range, or a decade away
    where that lies on the wrong side. scale: in place of the declared one. Raises ModelError for
    a range that is none, that leaves the physical limits, or whose scale it does not suit.
    """
    low, high = (parameter.lower, parameter.upper) if given is None else given
    minimum, maximum = parameter.minimum, parameter.maximum
    ends = [end for end in (low, high) if end is not None]
    if not ends:
        raise ModelError(
            f"parameter {parameter.name}: a range needs at least one end; write [low, high], "
            "[low, null] or [null, high]"
        )
    if min(ends) < minimum or max(ends) > maximum:
        shown = ", ".join("null" if end is None else f"{end:g}" for end in (low, high))
        raise ModelError(
            f"parameter {parameter.name}: range [{shown}] leaves what is physically possible, "
            f"[{minimum:g}, {maximum:g}]"
        )
    if high is None:
        assert low is not None
        minimum = max(minimum, low)
        high = parameter.upper if parameter.upper > low else min(_decade_above(low), maximum)
    elif low is None:
        maximum = min(maximum, high)
        low = parameter.lower if parameter.lower < high else max(_decade_below(high), minimum)
    # A range that touches zero cannot be searched by logarithm, unless that is asked for.
    chosen: Scale = scale or (parameter.scale if low > 0.0 else "linear")
    check_range(parameter.name, low, high, chosen)
    return replace(
        parameter, nominal=min(max(parameter.nominal, minimum), maximum), lower=low, upper=high,
        scale=chosen, fixed=False, minimum=minimum, maximum=maximum,
    )  # fmt: skip


def ties(model: ProcessModel, tied: Mapping[str, str]) -> tuple[Tie, ...]:
    """Parameters that are multiples of others, from texts such as ``0.5 * R_m`` by name.

    A chain of ties is followed to its end. Raises ModelError for a text that is no multiple,
    an unknown name, or parameters that follow one another in a circle.
    """
    parsed = {name: _parse(model, name, text) for name, text in tied.items()}
    names = model.parameter_names
    resolved = []
    for name in parsed:
        factor, source, chain = 1.0, name, [name]
        while source in parsed:
            step, source = parsed[source]
            factor *= step
            chain.append(source)
            if chain.count(source) > 1:
                raise ModelError(
                    f"parameter {name}: tied in a circle, {' -> '.join(chain)}; "
                    "leave one of them out"
                )
        resolved.append(Tie(names.index(name), names.index(source), factor))
    return tuple(resolved)


def _parse(model: ProcessModel, name: str, text: str) -> tuple[float, str]:
    """Factor and source of a tie."""
    model.parameter(name)
    match = _TIE.fullmatch(text.strip())
    if match is None:
        raise ModelError(
            f"parameter {name}: {text!r} is no multiple of another parameter; write it as "
            "'R_m', '0.5 * R_m' or 'R_m / 2'"
        )
    model.parameter(match["name"])
    factor = float(match["before"] or 1.0) * (-1.0 if match["sign"] == "-" else 1.0)
    behind = float(match["behind"] or 1.0)
    divides = match["sign_behind"] == "/" and behind != 0.0
    factor = factor / behind if divides else factor * behind
    if factor == 0.0:
        raise ModelError(f"parameter {name}: {text!r} multiplies or divides by zero")
    return factor, match["name"]


def _decade_above(low: float) -> float:
    if low == 0.0:
        return 1.0
    return low * _DECADE if low > 0.0 else low + _DECADE * abs(low)


def _decade_below(high: float) -> float:
    if high == 0.0:
        return -1.0
    return high / _DECADE if high > 0.0 else high - _DECADE * abs(high)
