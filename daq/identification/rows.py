"""The tables of an identification: one model of them, for terminal, page, LaTeX and figures.

They are read from an identification's document, whether it has just been made or stands in a file.
Numbers that JSON cannot hold, and errors of outputs that were not measured, are NaN.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from daq import notation
from daq.notation import percent, quantity
from daq.views import Lines, Shown

_Z95 = 1.96
LABELS = {  # of undetermined reasons
    "tied": "only together",
    "vague": "hardly felt",
    "rival": "two answers",
    "end": "at its end",
    "": "",
}


_START = "(0)"  # behind a state, in the name of its start; of several logs a number follows

Interval = tuple[float | None, float | None]
"""Ends of an interval, None on a side on which the data set none."""


@dataclass(frozen=True)
class QuantityRow:
    """A parameter or a combination of some: value, unit, and its 95 % interval where it has one.

    undetermined: why there is no interval, a key of ``LABELS``. here: the interval around this
    one of several answers. fails: share of the range in which the model cannot be simulated.
    """

    name: str
    value: float
    unit: str
    interval: Interval | None = None
    std: float | None = None
    undetermined: str = ""
    here: Interval | None = None
    fails: float = 0.0

    @property
    def is_start(self) -> bool:
        """Whether it holds where a state starts in a log, which tells nothing of the system."""
        return _START in self.name

    @property
    def digits(self) -> int:
        """Significant digits that the interval supports."""
        return notation.digits(self.value, self.deviation)

    @property
    def deviation(self) -> float | None:
        """Standard deviation, or what an interval of its width would have."""
        low, high = self.interval or self.here or (None, None)
        if self.std is not None or low is None or high is None:
            return self.std
        return (high - low) / (2.0 * _Z95)

    @property
    def engineering(self) -> tuple[float, str]:
        """Factor and unit in which its value has one to three digits before the point."""
        return notation.engineering(self.value, self.unit)

    def text(self, number: float, scale: float = 1.0) -> str:
        """The value, or an end of an interval, times the scale, as fine as the interval supports.

        All of a quantity's numbers have the same last decimal place, with two digits at least
        where the interval does not reach through zero.
        """
        low, high = self.interval or self.here or (None, None)
        through_zero = low is not None and high is not None and low < 0.0 < high
        largest = max(abs(self.value), (self.deviation or 0.0) if through_zero else 0.0)
        if number == 0.0 or not math.isfinite(number) or not 0.0 < largest < math.inf:
            return notation.number(scale * number)
        beyond = math.floor(math.log10(abs(number))) - math.floor(math.log10(largest))
        digits = min(self.digits + beyond, self.digits + 1)
        if digits < 1 and through_zero:
            return "0"
        return notation.number(scale * number, max(digits, 1 if through_zero else 2))

    @property
    def two_sided(self) -> bool:
        """Whether it has an interval with both ends."""
        return self.interval is not None and None not in self.interval

    @property
    def narrow(self) -> bool:
        """Whether the digits of a value do not tell the ends of its interval apart."""
        low, high = self.interval or (None, None)
        if low is None or high is None or low == high:
            return False
        return self.text(low) == self.text(high)

    @property
    def half_width(self) -> float:
        """Half of an interval that has both ends, else NaN."""
        low, high = self.interval or (None, None)
        return math.nan if low is None or high is None else 0.5 * (high - low)

    @property
    def undetermined_label(self) -> str:
        """Why there is no interval, or what ends it, in a few words."""
        fails = f"simulations fail in {100.0 * self.fails:.0f} % of the range" if self.fails else ""
        return ", ".join(filter(None, (LABELS.get(self.undetermined, ""), fails)))

    def span(self, scale: float = 1.0) -> str:
        """The interval as a terminal shows it, times the scale; a dash for none."""
        return self.interval_text(lambda end: self.text(end, scale), between=" .. ", empty="-")

    def interval_text(self, write: Callable[[float], str], between: str, empty: str) -> str:
        """The interval with its ends written: ``1.0 .. 1.2``, ``< 1.2``, or ``> 1.0``.

        ``± 3.0e-12`` where the digits of the ends do not tell them apart.
        """
        low, high = self.interval or (None, None)
        if low is None and high is None:
            return empty
        if low is None or high is None:
            return f"< {write(high)}" if high is not None else f"> {write(low or 0.0)}"
        if self.narrow:
            return f"± {write(self.half_width)}"
        return f"{write(low)}{between}{write(high)}"


@dataclass(frozen=True)
class ParameterRow(QuantityRow):
    """A parameter of the model: searched in a range, tied to others, or fixed.

    source: where its range or value comes from. on_bound: whether it stands on an end of its
    range; pushed: whether the data want it beyond; harmless: whether that end decides nothing;
    at_limit: whether it is a physical limit.
    """

    range: tuple[float, float] | None = None
    logarithmic: bool = False
    on_bound: bool = False
    pushed: bool = False
    harmless: bool = False
    at_limit: bool = False
    tied: str | None = None
    source: str = "model"
    description: str = ""

    @property
    def held(self) -> str:
        """What holds it, ``= 2*K_m`` or ``fixed``; empty where it is searched."""
        if self.free:
            return ""
        return f"= {self.tied}" if self.tied is not None else "fixed"

    @property
    def free(self) -> bool:
        """Whether it was searched."""
        return self.range is not None

    @property
    def digits(self) -> int:
        """Significant digits: of a tied one, and where no interval was looked for, four."""
        sought = self.free and (self.interval is not None or bool(self.undetermined))
        return super().digits if sought else 4

    def text(self, number: float, scale: float = 1.0) -> str:
        """As of any quantity; what was fixed as it was given."""
        fixed = not self.free and self.tied is None
        return notation.shortest(scale * number) if fixed else super().text(number, scale)

    @property
    def label(self) -> str:
        """Why it has no interval, and that it stands on an end of its range."""
        end = "at its limit" if self.at_limit else "at its end"
        decided = end if self.on_bound and not self.harmless else ""
        return ", ".join(filter(None, (self.undetermined_label, decided)))


@dataclass(frozen=True)
class AmbiguityRow:
    """Parameters that cannot be told apart, as ``sysid.uncertainty.Ambiguity`` has them."""

    kind: str
    parameters: tuple[str, ...]
    determined: tuple[QuantityRow, ...]
    measure: tuple[str, ...]


@dataclass(frozen=True)
class RivalRow:
    """Another minimum that explains the data as well: its parameters, and their intervals."""

    values: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class OutputErrors:
    """Errors of the free run in one output; rmse and msd in parts of the largest measured value.

    rmse_absolute, msd_absolute: the same in the output's unit; NaN in documents without. whiteness:
    share of the residual's autocorrelations inside their 95 % band. independence: by input, share
    of the cross-correlations inside theirs.
    """

    rmse: float
    msd: float
    fit_percent: float
    rmse_absolute: float = math.nan
    msd_absolute: float = math.nan
    unit: str = ""
    whiteness: float = math.nan
    independence: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> OutputErrors:
        """From an output's entry in a document."""
        independence = entry.get("residual_independent_of", {})
        return cls(
            _number(entry["rmse"]),
            _number(entry["msd"]),
            _number(entry["fit_percent"]),
            _number(entry.get("rmse_absolute")),
            _number(entry.get("msd_absolute")),
            entry.get("unit", ""),
            _number(entry.get("residual_autocorrelation_in_band")),
            {signal: _number(share) for signal, share in independence.items()},
        )

    @classmethod
    def mean(cls, errors: Sequence[OutputErrors]) -> OutputErrors:
        """The mean over logs of what is known."""
        signals = dict.fromkeys(signal for e in errors for signal in e.independence)
        return cls(
            _mean(e.rmse for e in errors),
            _mean(e.msd for e in errors),
            _mean(e.fit_percent for e in errors),
            _mean(e.rmse_absolute for e in errors),
            _mean(e.msd_absolute for e in errors),
            errors[0].unit,
            _mean(e.whiteness for e in errors),
            {s: _mean(e.independence.get(s, math.nan) for e in errors) for s in signals},
        )

    @property
    def figures(self) -> dict[str, float]:
        """RMSE, MSD and fit by name, then RMSE and MSD in the output's unit."""
        names = ("rmse", "msd", "fit_percent", "rmse_absolute", "msd_absolute")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class LogErrors:
    """Errors of the free run on one log, by output."""

    name: str
    outputs: Mapping[str, OutputErrors]


@dataclass(frozen=True)
class ResidualTable:
    """Shares of correlations inside their bands by output: with its own past, with each input.

    part: the logs that they are means over.
    """

    part: str
    inputs: tuple[str, ...]
    shares: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True, repr=False)
class Rows(Shown):
    """Tables of an identification.

    rivals: other minima that explain the data as well. correlations: of parameters that have an
    interval of their own. logs: ``training`` and ``validation``. refined: whether the search was
    refined to a minimum, without which nothing has an interval. together: share of repetitions in
    which all intervals hold, and the factor that widens them until that is 95 %. disagreement:
    variance between logs, or parts of the only one, in parts of what noise makes.
    """

    parameters: tuple[ParameterRow, ...]
    ambiguities: tuple[AmbiguityRow, ...]
    rivals: tuple[RivalRow, ...]
    correlations: Mapping[tuple[str, str], float]
    logs: Mapping[str, tuple[LogErrors, ...]]
    refined: bool
    together: tuple[float, float] | None = None
    disagreement: float = 1.0

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Rows:
        """From an identification's document."""
        return cls(
            tuple(_parameter(name, entry) for name, entry in document["parameters"].items()),
            tuple(map(_ambiguity, document.get("ambiguities", ()))),
            tuple(map(_rival, document.get("rivals", ()))),
            {
                (pair["parameters"][0], pair["parameters"][1]): pair["correlation"]
                for pair in document.get("correlations", ())
            },
            {part: logs_of(document["metrics"], part) for part in ("training", "validation")},
            "determined_directions" in document,
            (together["coverage"], together["widening"])
            if (together := document.get("together"))
            else None,
            document.get("disagreement", 1.0),
        )

    def parameter(self, name: str) -> ParameterRow:
        """The row of a parameter. Raises KeyError for a name that is none's."""
        return {row.name: row for row in self.parameters}[name]

    @property
    def errors(self) -> list[dict[str, str | float]]:
        """Figures of each part, log and output, by their names."""
        return [
            {"part": part, "log": log.name, "output": output, **errors.figures, "unit": errors.unit}
            for part, logs in self.logs.items()
            for log in logs
            for output, errors in log.outputs.items()
        ]

    @cached_property
    def free(self) -> tuple[ParameterRow, ...]:
        """Parameters that were searched."""
        return tuple(row for row in self.parameters if row.free)

    @cached_property
    def determined(self) -> tuple[ParameterRow, ...]:
        """Free parameters with an interval of their own, of both ends."""
        return tuple(row for row in self.free if row.two_sided)

    @cached_property
    def bounded(self) -> tuple[ParameterRow, ...]:
        """Free parameters that the data bound on one side."""
        return tuple(row for row in self.free if row.interval is not None and not row.two_sided)

    @cached_property
    def weak(self) -> tuple[ParameterRow, ...]:
        """Free parameters that the data bound on one side or on none."""
        return tuple(row for row in self.free if row in self.bounded or row.undetermined == "vague")

    @cached_property
    def combinations(self) -> tuple[QuantityRow, ...]:
        """Combinations of parameters that have an interval."""
        return tuple(row for row in self._combined if not row.is_start)

    @cached_property
    def starts(self) -> tuple[QuantityRow, ...]:
        """Combinations with starts of states in the logs that have an interval."""
        return tuple(row for row in self._combined if row.is_start)

    @cached_property
    def _combined(self) -> tuple[QuantityRow, ...]:
        combined = (row for ambiguity in self.ambiguities for row in ambiguity.determined)
        return tuple(row for row in combined if row.interval is not None)

    def ambiguities_of(self, *kinds: str) -> tuple[AmbiguityRow, ...]:
        """Ambiguities of some kinds: ``tied``, ``rival``."""
        return tuple(ambiguity for ambiguity in self.ambiguities if ambiguity.kind in kinds)

    @property
    def headline(self) -> str:
        """How many parameters are known by themselves, and how many otherwise."""
        parts = [f"{len(self.determined)} of {len(self.free)} free parameters each by itself"]
        if self.bounded:
            parts.append(f"{len(self.bounded)} on one side")
        if self.combinations:
            n = len(self.combinations)
            parts.append(f"{n} combination{'' if n == 1 else 's'}")
        if self.starts:
            n = len(self.starts)
            parts.append("1 start of a log" if n == 1 else f"{n} starts of logs")
        last = f" and {parts.pop()}" if len(parts) > 1 else ""
        return f"{', '.join(parts)}{last}"

    def lines(self) -> Lines:
        """Parameters and combinations with their 95 % intervals, and the fit of each output."""
        lines = [["quantity", "value", "95 % interval", "unit", ""]]
        notes = [row.held or row.undetermined_label for row in self.parameters]
        notes += [""] * len(self.combinations)
        for row, note in zip((*self.parameters, *self.combinations), notes, strict=True):
            scale, unit = row.engineering
            lines.append([row.name, row.text(row.value, scale), row.span(scale), unit, note])
        lines += [
            [f"fit of {output}", percent(errors.fit_percent), "-", "%", f"{part}, {log.name}"]
            for part, logs in self.logs.items()
            for log in logs
            for output, errors in log.outputs.items()
        ]
        return lines

    @property
    def determined_sentence(self) -> str:
        """The headline as a sentence."""
        return f"Determined: {self.headline}."

    @property
    def together_sentence(self) -> str:
        """How surely all intervals hold at once; empty of fewer than two."""
        n = len(self.determined) + len(self.bounded) + len(self._combined)
        if self.together is None or n < 2:
            return ""
        coverage, widening = self.together
        return (
            f"Of 100 repetitions each interval holds the true value in 95, all {n} at once in "
            f"{100.0 * coverage:.0f}. Intervals {widening:.2f} times as wide would all hold in 95."
        )

    @property
    def disagreement_sentence(self) -> str:
        """That logs want parameters of their own; empty where they do not."""
        if self.disagreement <= 1.0:
            return ""
        several = len(self.logs["training"]) > 1
        parts = "The logs" if several else "Parts of the log"
        return (
            f"{parts}, each by itself, give parameters {self.disagreement**0.5:.1f} times as far "
            "apart as noise explains; the intervals are as wide as that spread."
        )

    @cached_property
    def residuals(self) -> ResidualTable:
        """Residual tests on the validation logs, or else on the training logs."""
        part = "validation" if self.logs["validation"] else "training"
        outputs = mean_errors(self.logs[part])
        inputs = tuple(next(iter(outputs.values())).independence)
        shares = {
            name: (errors.whiteness, *(errors.independence[signal] for signal in inputs))
            for name, errors in outputs.items()
        }
        return ResidualTable(part, inputs, shares)


def logs_of(metrics: Mapping[str, Any], part: str) -> tuple[LogErrors, ...]:
    """Errors on the logs of a part, from the ``metrics`` of a document."""
    return tuple(
        LogErrors(log.get("name", ""), {k: OutputErrors.of(e) for k, e in log["outputs"].items()})
        for log in metrics[part]
    )


def by_state(name: str) -> str:
    """A name in which starts are those of a state in whichever log.

    >>> by_state("alpha1 z(0) 11")
    'alpha1 z(0)'
    """
    return re.sub(rf"({re.escape(_START)}) \d+", r"\1", name)


@dataclass(frozen=True)
class StartRow:
    """A combination with the start of a state, in each of some logs."""

    name: str
    rows: tuple[QuantityRow, ...]

    @classmethod
    def grouped(cls, rows: Iterable[QuantityRow]) -> list[StartRow]:
        """Of all rows with starts, a group for those that differ by the log alone."""
        groups: dict[str, list[QuantityRow]] = {}
        for row in rows:
            groups.setdefault(by_state(row.name), []).append(row)
        return [cls(name, tuple(group)) for name, group in groups.items()]

    @property
    def values(self) -> tuple[float, float]:
        """The least and the largest."""
        values = [row.value for row in self.rows]
        return min(values), max(values)

    @property
    def interval(self) -> tuple[float, float] | None:
        """What their 95 % intervals reach over; None where any of them has not both ends."""
        if not all(row.two_sided for row in self.rows):
            return None
        ends = [end for row in self.rows for end in row.interval or () if end is not None]
        return min(ends), max(ends)


def start_sentences(logs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Where logs start that were estimated, and what their first samples would give.

    logs: of a document's ``metrics``.
    """
    sentences = []
    for log in logs:
        if "fit_percent_from_first_sample" not in log:
            continue
        where = [
            f"{state} at {quantity(start['value'], start['unit'])}, "
            f"{quantity(start['value'] - start['first_sample'], start['unit'], 2)} away from its "
            f"first sample (searched in {quantity(start['range'][0], start['unit'])} .. "
            f"{quantity(start['range'][1], start['unit'])})"
            for state, start in log["starts"].items()
            if start.get("first_sample") is not None
        ]
        fits = [
            f"{name} {percent(errors['fit_percent'])} -> {percent(_number(first))} %"
            for (name, errors), first in zip(
                log["outputs"].items(), log["fit_percent_from_first_sample"].values(), strict=True
            )
        ]
        sentences.append(
            f"{log['name']} starts with {'; '.join(where)}. Started at the first "
            f"sample: {', '.join(fits)}."
        )
    return sentences


def mean_errors(logs: Sequence[LogErrors]) -> dict[str, OutputErrors]:
    """Errors by output, mean over logs; empty without any."""
    outputs = logs[0].outputs if logs else ()
    return {name: OutputErrors.mean([log.outputs[name] for log in logs]) for name in outputs}


def _parameter(name: str, entry: Mapping[str, Any]) -> ParameterRow:
    return ParameterRow(
        **_quantity(name, entry),
        range=_ends(entry.get("range")),
        logarithmic=entry.get("scale") == "log",
        on_bound=bool(entry.get("on_bound")),
        pushed=bool(entry.get("pushed")),
        harmless=bool(entry.get("harmless")),
        at_limit=bool(entry.get("at_limit")),
        tied=entry.get("tied"),
        source=entry.get("source", "model"),
        description=entry.get("description", ""),
    )


def _quantity(name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a ``QuantityRow``."""
    return {
        "name": name,
        "value": entry["value"],
        "unit": entry["unit"],
        "interval": _ends(entry.get("interval")),
        "std": entry.get("std"),
        "undetermined": entry.get("undetermined", ""),
        "here": _ends(entry.get("interval_here")),
        "fails": entry.get("fails", 0.0),
    }


def _rival(entry: Mapping[str, Any]) -> RivalRow:
    """Of documents written before rivals had intervals, whose entries are the parameters."""
    if "intervals" not in entry:
        return RivalRow(entry, {})
    return RivalRow(entry["parameters"], {k: (v[0], v[1]) for k, v in entry["intervals"].items()})


def _ambiguity(entry: Mapping[str, Any]) -> AmbiguityRow:
    determined = tuple(QuantityRow(**_quantity(q["name"], q)) for q in entry["determined"])
    parameters, measure = tuple(entry["parameters"]), tuple(entry["measure"])
    return AmbiguityRow(entry["kind"], parameters, determined, measure)


def _ends(values: Sequence[Any] | None) -> tuple[Any, Any] | None:
    return None if values is None else (values[0], values[1])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _mean(values: Iterable[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan
