"""Settings that take out of an identification what was found wrong with its data and ranges."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from daq.config.identification import IdentificationConfig
from daq.notation import shortest
from sysid.problem.faults import DataFault

if TYPE_CHECKING:
    from sysid.judging.score_tests import Finding

_WIDER = 10.0  # by which factor a range is widened


def remedies(
    settings: IdentificationConfig,
    channels: Collection[str] = (),
    *,
    faults: Sequence[DataFault] = (),
    findings: Sequence[Finding] = (),
    pushed: Mapping[str, tuple[float, float, float]] | None = None,
) -> tuple[str, ...]:
    """``KEY=VALUE`` for each thing found that a setting mends, empty for none.

    channels: names of the model's inputs and outputs. pushed: value and range, searched on a
    logarithm, of what the data want beyond it.

    >>> from sysid.problem.faults import DataFault
    >>> late = DataFault("lag", "doubt", "training", ("log",), "y", "", "", "", 1.0,
    ...     setting="delay.y=0.004")
    >>> remedies(IdentificationConfig(), faults=[late])
    ('delay.y=0.004',)
    """
    of_faults = [fault.setting for fault in faults if fault.severity == "doubt" and fault.setting]
    changes: dict[str, str] = dict(setting.split("=", 1) for setting in of_faults)
    lags = any(fault.kind == "lag" for fault in faults)  # which delays that were found are as well
    of_all_logs = [f for f in findings if f.name in channels and not (lags and f.kind == "delay")]
    changes |= dict(_of_channels(settings, of_all_logs))
    if not changes:  # what is wrong with the data drives parameters to the ends
        changes |= dict(_of_ranges(pushed or {}))
    return tuple(f"{key}={value}" for key, value in changes.items())


def _of_channels(
    settings: IdentificationConfig, findings: Sequence[Finding]
) -> Iterator[tuple[str, str]]:
    """Delays, gains and offsets that channels of all logs have, and signs of a foreign file's."""
    columns: Mapping[str, str] = {}
    if settings.columns is not None:
        parts = {"inputs": settings.columns.inputs, "outputs": settings.columns.outputs}
        columns = {
            name: f"columns.{part}.{name}.sign={-column.sign}"
            for part, signals in parts.items()
            for name, column in signals.items()
        }
    for finding in findings:
        if finding.kind == "delay" and finding.counts and finding.amplitude is not None:
            late = settings.delay.get(finding.name, 0.0) + finding.amplitude
            yield f"delay.{finding.name}", shortest(float(f"{late:.3g}"))
        if finding.turned_round:
            if finding.name in columns:
                key, _, value = columns[finding.name].partition("=")
                yield key, value
        elif finding.kind in _ERRORS and finding.counts and finding.amplitude is not None:
            ends = _ERRORS[finding.kind](finding.amplitude)
            text = ", ".join(shortest(float(f"{end:.3g}")) for end in ends)
            yield f"channels.{finding.name}.{finding.kind}", f"[{text}]"


# Ranges of errors of channels, by the change of a gain of 1, and by an offset.
_ERRORS: Mapping[str, Callable[[float], tuple[float, float]]] = {
    "gain": lambda change: (min(1.0, 1.0 + change) / 2.0, max(1.0, 1.0 + change) * 2.0),
    "offset": lambda size: (-5.0 * abs(size), 5.0 * abs(size)),
}


def _of_ranges(pushed: Mapping[str, tuple[float, float, float]]) -> Iterator[tuple[str, str]]:
    for name, (value, low, high) in pushed.items():
        at_low = value / low < high / value
        ends = (low / _WIDER, high) if at_low else (low, high * _WIDER)
        yield f"ranges.{name}", f"[{shortest(ends[0])}, {shortest(ends[1])}]"
