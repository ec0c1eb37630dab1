"""Settings that take out of an identification what was found wrong with its data and ranges."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from daq.config.identification import Column, IdentificationConfig
from daq.config.units import factor
from daq.notation import shortest
from sysid.problem.faults import DataFault

if TYPE_CHECKING:
    from sysid.judging.findings import Finding
    from sysid.judging.starts import Start

_WIDER = 10.0  # by which factor a range is widened
_WIDER_START = 2.0  # ranges by which one of a start is widened on either side
_ALIKE = 0.02  # by which a gain may differ from that between two units
_ANGLES = ("rpm", "deg/s", "turn/s", "rad/s", "deg", "turn", "rad")
_PREFIXES = ("m", "k")
_OF_SAMPLES = ("clipped", "frozen", "gap", "outliers")  # kinds of faults


def remedies(
    settings: IdentificationConfig,
    channels: Mapping[str, str] | None = None,
    *,
    faults: Sequence[DataFault] = (),
    findings: Sequence[Finding] = (),
    pushed: Mapping[str, tuple[float, float, float]] | None = None,
    starts: Sequence[Start] = (),
) -> tuple[str, ...]:
    """``KEY=VALUE`` for each thing found that a setting mends, empty for none.

    channels: units of the model's inputs and outputs by name. pushed: value and range, searched on
    a logarithm, of what the data want beyond it. starts: initial states that were estimated.

    >>> from sysid.problem.faults import DataFault
    >>> late = DataFault("lag", "doubt", "training", ("log",), "y", "", "", "", 1.0,
    ...     settings=("delay.y=0.004",))
    >>> remedies(IdentificationConfig(), faults=[late])
    ('delay.y=0.004',)
    """
    doubts = [fault for fault in faults if fault.severity == "doubt"]
    of_faults = [setting for fault in doubts for setting in fault.settings]
    changes: dict[str, str] = dict(_of_starts(starts))
    changes |= dict(setting.split("=", 1) for setting in of_faults)
    # A lag is what delays that were found are as well, and noise of an input may look like one.
    late = any(fault.kind == "lag" for fault in faults) or any(f.kind == "noise" for f in findings)
    units = channels or {}
    whole = [f for f in findings if f.name in units or f.kind == "exchange"]
    of_all_logs = [f for f in whole if not (late and f.comes_late)]
    # A gain or offset that wrong samples, or unknown inputs in a gap, may feign is not fitted yet.
    spoiled = any(fault.kind in _OF_SAMPLES for fault in doubts)
    of_channels = dict(_of_channels(settings, of_all_logs, units)).items()
    changes |= {f"fixed.{f.name}": "null" for f in findings if f.kind == "fixed" and f.counts}
    changes |= {k: v for k, v in of_channels if not (spoiled and k.startswith("channels."))}
    if not changes and not spoiled:  # what is wrong with the data drives parameters to the ends
        changes |= dict(_of_ranges(pushed or {}))
    return tuple(f"{key}={value}" for key, value in changes.items())


def _of_starts(starts: Sequence[Start]) -> Iterator[tuple[str, str]]:
    """Wider ranges of starts that stand on an end; an end at 0 is what physics allows."""
    for name in dict.fromkeys(start.state for start in starts if start.on_end):
        ranges = [(start.low, start.high) for start in starts if start.state == name]
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        more = _WIDER_START * (high - low)
        ends = (low - more if low else 0.0, high + more if high else 0.0)
        yield f"initial.{name}", f"[{ends[0]:.3g}, {ends[1]:.3g}]"


def _of_channels(
    settings: IdentificationConfig, findings: Sequence[Finding], units: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """Delays, gains and offsets of channels in all logs; signs and units of a foreign file's."""
    columns: dict[str, tuple[str, Column]] = {}
    if settings.columns is not None:
        parts = {"inputs": settings.columns.inputs, "outputs": settings.columns.outputs}
        columns = {
            name: (f"columns.{part}.{name}", column)
            for part, signals in parts.items()
            for name, column in signals.items()
        }
    for finding in findings:
        if finding.kind == "exchange":
            pair = finding.name.split(" and ")
            for name, taken in zip(pair, reversed(pair), strict=True):
                if name in columns and taken in columns:
                    yield f"{columns[name][0]}.column", columns[taken][1].column or taken
        yield from _as_logged(settings, finding)
        key, column = columns.get(finding.name, ("", None))
        unit = None
        if column is not None and finding.kind == "gain" and finding.amplitude is not None:
            unit = _taken_for(column.unit or units[finding.name], 1.0 + finding.amplitude)
        if finding.turned_round:
            if column is not None:
                yield f"{key}.sign", str(-column.sign)
        elif unit is not None and finding.counts:
            yield f"{key}.unit", unit
        elif finding.kind in _ERRORS and finding.counts and finding.amplitude is not None:
            ends = _ERRORS[finding.kind](finding.amplitude)
            text = ", ".join(shortest(float(f"{end:.3g}")) for end in ends)
            yield f"channels.{finding.name}.{finding.kind}", f"[{text}]"


def _as_logged(settings: IdentificationConfig, finding: Finding) -> Iterator[tuple[str, str]]:
    """What a channel's samples are: late, means over a time, or noisy."""
    name, amplitude = finding.name, finding.amplitude
    if amplitude is None:
        return
    taken_out = {"delay": ("delay", settings.delay), "filter": ("filtered", settings.filtered)}
    if finding.kind in taken_out and finding.counts:
        key, times = taken_out[finding.kind]
        yield f"{key}.{name}", shortest(float(f"{times.get(name, 0.0) + amplitude:.3g}"))
    if finding.late and finding.counts:
        late = settings.delay.get(name, 0.0) + finding.late
        yield f"delay.{name}", shortest(float(f"{late:.3g}"))
    if finding.kind == "mean" and finding.counts:
        yield f"averaged.{name}", shortest(float(f"{amplitude:.6g}"))
    if finding.kind == "noise":
        yield f"noise.{name}", shortest(float(f"{amplitude:.2g}"))


def _taken_for(unit: str, times: float) -> str | None:
    """The unit of numbers that are so many times what they would be in another; None for none."""
    prefixes = [prefix + unit for prefix in _PREFIXES] + [unit[1:]] * (unit[:1] in _PREFIXES)
    for name in (*_ANGLES, *prefixes):
        with contextlib.suppress(ValueError):
            if name and math.isclose(factor(name, unit) * times, 1.0, rel_tol=_ALIKE):
                return name
    return None


# Ranges of errors of channels, by the change of a gain of 1, by an offset and by a drift.
_ERRORS: Mapping[str, Callable[[float], tuple[float, float]]] = {
    "gain": lambda change: (min(1.0, 1.0 + change) / 2.0, max(1.0, 1.0 + change) * 2.0),
    **dict.fromkeys(("offset", "drift"), lambda size: (-5.0 * abs(size), 5.0 * abs(size))),
}


def _of_ranges(pushed: Mapping[str, tuple[float, float, float]]) -> Iterator[tuple[str, str]]:
    for name, (value, low, high) in pushed.items():
        at_low = value / low < high / value
        ends = (low / _WIDER, high) if at_low else (low, high * _WIDER)
        yield f"ranges.{name}", f"[{shortest(ends[0])}, {shortest(ends[1])}]"
