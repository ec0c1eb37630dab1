"""The tables of an identification: one model of them, for terminal, page, LaTeX and figures.

They are read from an identification's document, whether it has just been made or stands in a file.
Numbers that JSON cannot hold, and errors of outputs that were not measured, are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from daq import notation

LABELS = {  # of undetermined reasons
    "tied": "only with others",
    "vague": "hardly felt",
    "bound": "at its end",
    "rival": "two answers",
    "": "",
}


@dataclass(frozen=True)
class QuantityRow:
    """A parameter or a combination of some: value, unit, and its 95 % interval where it has one.

    undetermined: why there is no interval, a key of ``LABELS``.
    """

    name: str
    value: float
    unit: str
    interval: tuple[float, float] | None = None
    std: float | None = None
    undetermined: str = ""

    @property
    def digits(self) -> int:
        """Significant digits that the interval supports."""
        return notation.digits(self.value, self.std)

    @property
    def undetermined_label(self) -> str:
        """Why there is no interval, in a few words."""
        return LABELS[self.undetermined]


@dataclass(frozen=True)
class ParameterRow(QuantityRow):
    """A parameter of the model: searched in a range, tied to others, or fixed.

    source: where its range or value comes from.
    """

    range: tuple[float, float] | None = None
    logarithmic: bool = False
    on_bound: bool = False
    tied: str | None = None
    source: str = "model"
    description: str = ""

    @property
    def free(self) -> bool:
        """Whether it was searched."""
        return self.range is not None

    @property
    def digits(self) -> int:
        """Significant digits: of a fixed or tied one four."""
        return notation.digits(self.value, self.std) if self.free else 4

    @property
    def label(self) -> str:
        """Why it has no interval, or that an end of its range holds it."""
        return LABELS[self.undetermined or ("bound" if self.on_bound else "")]


@dataclass(frozen=True)
class AmbiguityRow:
    """Parameters that the data do not tell apart, as ``sysid.uncertainty.Ambiguity`` has them."""

    kind: str
    parameters: tuple[str, ...]
    determined: tuple[QuantityRow, ...]
    measure: tuple[str, ...]


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


@dataclass(frozen=True)
class Rows:
    """Tables of an identification.

    rivals: other minima that explain the data as well. correlations: of parameters that have an
    interval of their own. logs: ``training`` and ``validation``. refined: whether the search was
    refined to a minimum, without which nothing has an interval.
    """

    parameters: tuple[ParameterRow, ...]
    ambiguities: tuple[AmbiguityRow, ...]
    rivals: tuple[Mapping[str, float], ...]
    correlations: Mapping[tuple[str, str], float]
    logs: Mapping[str, tuple[LogErrors, ...]]
    refined: bool

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Rows:
        """From an identification's document."""
        return cls(
            tuple(_parameter(name, entry) for name, entry in document["parameters"].items()),
            tuple(map(_ambiguity, document.get("ambiguities", ()))),
            tuple(document.get("rivals", ())),
            {
                (pair["parameters"][0], pair["parameters"][1]): pair["correlation"]
                for pair in document.get("correlations", ())
            },
            {part: logs_of(document["metrics"], part) for part in ("training", "validation")},
            "determined_directions" in document,
        )

    def parameter(self, name: str) -> ParameterRow:
        """The row of a parameter. Raises KeyError for a name that is none's."""
        return {row.name: row for row in self.parameters}[name]

    @cached_property
    def free(self) -> tuple[ParameterRow, ...]:
        """Parameters that were searched."""
        return tuple(row for row in self.parameters if row.free)

    @cached_property
    def determined(self) -> tuple[ParameterRow, ...]:
        """Free parameters with an interval of their own."""
        return tuple(row for row in self.free if row.interval is not None)

    @cached_property
    def combinations(self) -> tuple[QuantityRow, ...]:
        """Combinations of parameters that have an interval."""
        return tuple(row for ambiguity in self.ambiguities for row in ambiguity.determined)

    def ambiguities_of(self, *kinds: str) -> tuple[AmbiguityRow, ...]:
        """Ambiguities of some kinds: ``product`` and ``sum`` are exact; ``vague``; ``rival``."""
        return tuple(ambiguity for ambiguity in self.ambiguities if ambiguity.kind in kinds)

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
    }


def _ambiguity(entry: Mapping[str, Any]) -> AmbiguityRow:
    determined = tuple(QuantityRow(**_quantity(q["name"], q)) for q in entry["determined"])
    parameters, measure = tuple(entry["parameters"]), tuple(entry["measure"])
    return AmbiguityRow(entry["kind"], parameters, determined, measure)


def _ends(values: Sequence[float] | None) -> tuple[float, float] | None:
    return None if values is None else (values[0], values[1])


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _mean(values: Iterable[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan
