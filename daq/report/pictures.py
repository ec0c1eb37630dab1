"""The figures of an identification's report: which are drawn, from which arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from matplotlib.figure import Figure

from daq.errors import ConfigError
from daq.figures import style
from daq.figures.bode import ComplexArray, bode
from daq.figures.findings import plot
from daq.figures.parameters import convergence, correlation, intervals, ranges
from daq.figures.responses import responses
from daq.figures.signals import (
    Panel,
    closer_sentence,
    overlaid,
    residual_correlations,
    signals,
    spectra,
)
from daq.files import write_whole
from daq.findings import Axis
from daq.identification.records import LoggedRecord
from daq.identification.replay import Replay, short_names
from daq.identification.rows import ParameterRow, Rows
from daq.logs.columns import UNITS
from daq.logs.recording import load
from daq.report.page import Picture
from sysid import Dataset, ModelError, Output, equilibrium, evaluate, linearize
from sysid.arrays import FloatArray
from sysid.judging.residual_tests import LAGS, residual_test
from sysid.problem.metrics import mean_known
from sysid.problem.model import ProcessModel
from sysid.problem.plots import Evidence, Plot
from sysid.response.frequency import FrequencyResponse, frequency_response, sampled_response
from sysid.response.linearization import LinearModel
from sysid.time_limit import AT_LENGTH, time_limit
from sysid.uncertainty.draws import plausible_parameters

if TYPE_CHECKING:
    from daq.identification.baseline import Baseline

_MOTIONS = {"N": ("m", "m/s"), "N*m": ("rad", "rad/s")}  # that a force or torque is drawn over
_OUTPUTS_A_FIGURE = 4
_DRAWS = 24  # of the parameters, for bands
_CLOSER = 60  # samples of a prepared log that are shown closer, as delays are of a few
_LOGS_A_PART = 3  # of more logs the worst, the middle and the best are shown
_FINE = 400  # frequencies over the band at which linear models are drawn
_COHERENT = 0.5  # coherence above which an input is seen in an output
_DECAYED = 3.0  # time constants, after which a twentieth is left
_MOST_LAGS = 1000  # of residuals' correlations that are drawn
_FEWEST_COHERENT = 4  # frequencies at which it must be, for a Bode plot

Given = TypeVar("Given")
Drawn = TypeVar("Drawn")
FreeRun = tuple[LoggedRecord, FloatArray]  # a log and the model's outputs, (n_samples, n_outputs)


@dataclass(frozen=True)
class Subject:
    """What is reported on: a finished identification, as its document holds it, and its logs.

    document: what ``report.json`` holds. baseline: what the free runs in validation are compared
    with, if anything.
    """

    model: ProcessModel
    document: Mapping[str, Any]
    training: Sequence[FreeRun]
    validation: Sequence[FreeRun]
    baseline: Baseline | None

    @cached_property
    def rows(self) -> Rows:
        """The document's tables."""
        return Rows.of(self.document)

    @property
    def vector(self) -> FloatArray:
        """All parameters, in the model's order."""
        return self.model.vector({row.name: float(row.value) for row in self.rows.parameters})

    @property
    def records(self) -> list[Dataset]:
        """The data of all logs."""
        return [log.dataset for log, _ in (*self.training, *self.validation)]

    @cached_property
    def linear(self) -> dict[str, LinearModel | None]:
        """The identified model linearised, by operating point; None without an equilibrium."""
        model, records = self.model, self.records
        u = np.concatenate([record.inputs for record in records]).mean(axis=0)
        points = _by_model(model, model.operating_points, records) if model.operating_points else {}
        points = points or {"linear, mean inputs": {}}
        return {name: _linearised(self, u, held) for name, held in points.items()}

    @property
    def foreign(self) -> bool:
        """Whether the first of the logs is not one of the program's own captures."""
        return not self.training[0][0].of_a_rig


def pictures(subject: Subject) -> Iterator[Picture]:
    """The figures, each yielded as soon as it is drawn."""
    yield from _responses(subject, "validation", subject.validation, subject.baseline)
    yield from _responses(subject, "training", subject.training, None)
    yield from _preparation(subject)
    yield from _excitation(subject)
    yield from _residuals(subject)
    yield from _search(subject.document)
    yield from _parameters(subject.rows)
    yield from _frequency(subject)
    yield from _plots_of_model(subject)


def _responses(
    subject: Subject, part: str, logs: Sequence[FreeRun], baseline: Baseline | None
) -> Iterator[Picture]:
    """Measured and simulated outputs of a part's logs."""
    outputs, validation = subject.model.outputs, part == "validation"
    data = "Validation: data not used" if validation else "Training: data used"
    against = f" and {baseline.name}" if baseline is not None else ""
    for place, word in _chosen(logs):
        log, run = logs[place][0].dataset, logs[place][1]
        simulated = {"identified": run}
        if baseline is not None:
            simulated[baseline.name] = baseline.runs[place]
        which = f"{log.name}, {word}" if word else log.name
        for first in range(0, len(outputs), _OUTPUTS_A_FIGURE):
            shown = range(first, min(first + _OUTPUTS_A_FIGURE, len(outputs)))
            panels = [_response(outputs[j], log, simulated, j) for j in shown]
            more = f"from-{outputs[first].name}" if first else ""
            yield Picture(
                _stem(part, word, more), "responses",
                f"{data} in the fit ({which}). Measured outputs, the identified model{against} "
                "simulated freely from the inputs alone, and below each the residual"
                f"{', measured minus simulated' if validation else ''}.{closer_sentence(panels)}",
                responses(log.time, panels),
            )  # fmt: skip


def _response(output: Output, log: Dataset, simulated: Mapping[str, FloatArray], j: int) -> Panel:
    """Output j of a log as measured and simulated, with the fit of each model."""
    fits = {name: _percent(evaluate(log.outputs, run).fit[j]) for name, run in simulated.items()}
    by_model = ", ".join(f"{name} {fit}" for name, fit in fits.items())
    note = f"fit: {by_model}" if len(fits) > 1 else f"fit {fits['identified']}"
    lines = {"measured": log.outputs[:, j]} | {name: run[:, j] for name, run in simulated.items()}
    return Panel(output.name, output.unit, lines, note=note)


def _percent(fit: float) -> str:
    return (f"{fit:.1f}".replace("-", "−") if np.isfinite(fit) else "–") + " %"


def _preparation(subject: Subject) -> Iterator[Picture]:
    """The first prepared log before and after."""
    logs = [log for log, _ in (*subject.training, *subject.validation)]
    shown = next((log for log in logs if log.preparation is not None), None)
    if shown is None or shown.preparation is None:
        return
    after = shown.preparation.after
    half = shown.preparation.start + 0.5 * after.n_samples * after.dt
    whole, middle = (0.0, np.inf), (half, half + _CLOSER * after.dt)
    sentence = f"The log {shown.dataset.name} before and after its preparation"
    yield Picture("preparation", "data", f"{sentence}.", _before_and_after(subject, shown, whole))
    if after.n_samples > 4 * _CLOSER:
        closer = f"{sentence}, {_CLOSER} samples in its middle."
        yield Picture(
            "preparation-closer", "data", closer, _before_and_after(subject, shown, middle)
        )


def _before_and_after(subject: Subject, log: LoggedRecord, part: tuple[float, float]) -> Figure:
    """Channels of a prepared log before and after, within a part of its time [s]."""
    assert log.preparation is not None
    start, after = log.preparation.start, log.preparation.after
    times, tables = [], []
    for record, begin in ((log.preparation.before, 0.0), (after, start)):
        time = record.time + begin
        shown = (time >= part[0]) & (time <= part[1])
        times.append(time[shown])
        tables.append((record.inputs[shown], record.outputs[shown]))
    sides = zip((subject.model.inputs, subject.model.outputs), *tables, strict=True)
    panels = [
        Panel(s.name, s.unit, {"as logged": raw, "as used": used}, getattr(s, "hold", "") == "zoh")
        for signals_of_side, *values in sides
        for s, raw, used in zip(signals_of_side, *(table.T for table in values), strict=True)
    ]
    return overlaid((times[0], times[1]), panels)


def _excitation(subject: Subject) -> Iterator[Picture]:
    log = subject.training[0][0]
    time, panels = (
        _foreign_signals(subject.model, log.dataset) if subject.foreign else _capture_signals(log)
    )
    yield Picture(
        "signals", "excitation",
        f"What was commanded and measured in the training log {log.dataset.name}."
        f"{closer_sentence(panels)}",
        signals(time, panels),
    )  # fmt: skip


def _residuals(subject: Subject) -> Iterator[Picture]:
    part = "validation" if subject.validation else "training"
    logs = subject.validation or subject.training
    (log, run), shown = logs[0], subject.document["metrics"][part][0]["outputs"]
    data = log.dataset
    if not np.isfinite(run).all():
        return
    lags = max(LAGS, math.ceil(min(_memory(subject) / data.dt, _MOST_LAGS)))
    test = residual_test(data.outputs - run, data.inputs, data.input_noise, lags)
    which = f"{data.name}, the first of {len(logs)}" if len(logs) > 1 else data.name
    shares = f" The table's shares are of the first {LAGS} lags." * (len(test.lags) > LAGS)
    lines = {}
    for j, output in enumerate(subject.model.outputs):
        lines[output.name] = {"with its past": test.auto[:, j] / float(test.auto_band[j])}
        # Those of the table, which know the parameters' uncertainty; of older reports chance's.
        bands = shown[output.name].get("residual_independence_bands", {})
        for i in np.flatnonzero(test.tested):
            name = subject.model.input_names[i]
            band = float(bands.get(name, test.cross_band[j, i]))
            lines[output.name][f"with {name}"] = test.cross[:, j, i] / band
    yield Picture(
        "residuals", "residuals",
        f"Correlation of the residuals ({which}) with their own past and with past inputs, in "
        "parts of the 95 % band (grey), that of inputs as wide as the parameters' uncertainty "
        f"makes it: a model that explains all but white noise stays inside.{shares}",
        residual_correlations(np.asarray(test.lags * data.dt), lines),
    )  # fmt: skip


def _search(document: Mapping[str, Any]) -> Iterator[Picture]:
    search = document["search"]
    history = np.asarray(search["history"], dtype=np.float64)
    before = float(document["error"]["before_refinement"])
    refined = len(history) and float(history[-1]) < before
    stages = (
        ". A genetic search over the whole range comes first, local least squares from its best "
        "points then."
    )
    yield Picture(
        "convergence", "search",
        "Convergence of the search: the best error against simulations spent"
        + (stages if refined else "."),
        convergence(history, int(search["population"]), before if refined else None),
    )  # fmt: skip


def _parameters(rows: Rows) -> Iterator[Picture]:
    if rows.free:
        open_circles = (
            " Open circles have no interval: the data do not determine these by themselves."
        ) * any(row.interval is None for row in rows.free)
        yield Picture(
            "ranges", "parameters",
            f"Every free parameter in the range that it was searched in.{open_circles}",
            ranges(
                [row.name for row in rows.free],
                np.array([_scaled_to_range(row) for row in rows.free]),
                [row.label for row in rows.free],
            ),
        )  # fmt: skip
    drawn = {
        row.name: (row.value, *row.interval)
        for row in (*rows.determined, *rows.combinations)
        if row.interval is not None and row.two_sided
    }
    if drawn:
        yield Picture(
            "intervals", "parameters",
            "95 % intervals of all that the data determine on both sides: parameters by "
            "themselves, and combinations of those that act only together."
            f"{' Those with starts of states in the logs are in the table.' * bool(rows.starts)}",
            intervals(list(drawn), np.array(list(drawn.values()))),
        )  # fmt: skip
    names = [row.name for row in rows.determined]
    if len(names) > 1:
        yield Picture(
            "correlation", "parameters",
            "Correlation of the estimates that have an interval of their own. ±1 means that one "
            "is known only as well as the other.",
            correlation(names, _correlations(names, rows)),
        )  # fmt: skip


def _scaled_to_range(row: ParameterRow) -> FloatArray:
    """Value and interval on the scale of the search: 0 at the range's low end, 1 at its high."""
    assert row.range is not None
    # Where the data set no end the range does.
    drawn = zip(row.interval, row.range, strict=True) if row.interval else ()
    ends = [limit if end is None else end for end, limit in drawn] or [np.nan, np.nan]
    values = np.array([row.value, *ends, *row.range])
    if row.logarithmic:
        values = np.log(np.maximum(values, np.finfo(float).tiny))
    value_and_ends, low, high = values[:3], values[3], values[4]
    # An interval wider than the range is drawn to just beyond its ends.
    scaled: FloatArray = np.clip((value_and_ends - low) / (high - low), -0.04, 1.04)
    return scaled


def _correlations(names: Sequence[str], rows: Rows) -> FloatArray:
    matrix = np.full((len(names), len(names)), np.nan)
    np.fill_diagonal(matrix, 1.0)
    for pair, coefficient in rows.correlations.items():
        if all(name in names for name in pair):
            i, j = (names.index(name) for name in pair)
            matrix[i, j] = matrix[j, i] = coefficient
    return matrix


def _frequency(subject: Subject) -> Iterator[Picture]:
    outputs, inputs = subject.model.outputs, subject.model.inputs
    # Each by all of its samples: where another is not measured does not matter.
    measured = {j: _response_of(subject.records, j) for j in range(len(outputs))}
    estimates = {j: estimate for j, estimate in measured.items() if estimate is not None}
    if not estimates:
        return  # too short, or of several sample rates: there is no estimate to show
    finest = max(estimates.values(), key=lambda estimate: len(estimate.frequency))
    causes = {j: _cause(estimate) for j, estimate in estimates.items()}
    unexplained = [output.name for j, output in enumerate(outputs) if causes.get(j) is None]
    missing = (
        f" No frequency response of {', '.join(unexplained)} is drawn: an input explains it (with "
        f"a coherence above {_COHERENT}) at fewer than {_FEWEST_COHERENT} frequencies, or it has "
        "too many gaps."
    ) * bool(unexplained)
    # Of all samples, also where no output is measured: a rare input may change just there.
    of_all = frequency_response([Dataset(r.inputs, r.inputs, r.dt) for r in subject.records])
    varied = np.flatnonzero(of_all.varied)
    densities = {inputs[i].name: of_all.input_density[:, i] for i in varied}
    yield Picture(
        "spectra", "excitation",
        "Spectra of the excitation: power spectral density of the inputs, Welch's estimate from "
        f"{of_all.n_segments} segments.{missing}",
        spectra(of_all.frequency, densities, {signal.name: signal.unit for signal in inputs}),
    )  # fmt: skip
    band = np.union1d(
        np.geomspace(finest.frequency[0], finest.frequency[-1], _FINE), finest.frequency
    )
    linear, lacking = _linear_responses(subject, band)
    simulated = _simulated(subject)
    for j, i in causes.items():
        if i is None:
            continue
        output, given, estimate = outputs[j], inputs[i], estimates[j]
        identified = _response_of(simulated, j) if simulated else None
        inside = band >= estimate.frequency[0]
        yield Picture(
            _stem("bode", output.name), "frequency",
            f"Frequency response from {given.name} to {output.name}, estimated from "
            f"{estimate.n_segments} segments of the logs. Left out are frequencies at which the "
            f"input has no power or the coherence may be that of noise.{lacking}",
            bode(
                estimate.frequency, estimate.response[:, 0, i], estimate.coherence[:, 0, i],
                estimate.deviation[:, 0, i] / np.sqrt(2.0), estimate.significant[:, 0, i],
                None if identified is None else identified.response[:, 0, i],
                band[inside],
                {name: response[inside, j, i] for name, response in linear.items()},
                (output.unit, given.unit),
            ),
        )  # fmt: skip


def _response_of(records: Sequence[Dataset], output: int) -> FrequencyResponse | None:
    """Of one output to all inputs; None where that cannot be estimated."""
    try:
        return frequency_response(
            [Dataset(record.inputs, record.outputs[:, output], record.dt) for record in records]
        )
    except ModelError:
        return None


def _cause(measured: FrequencyResponse) -> int | None:
    """The input that is most coherent with an output, if any is coherent enough."""
    coherent = (measured.coherence[:, 0] > _COHERENT) & measured.significant[:, 0]
    n_coherent = np.sum(coherent, axis=0)
    cause = int(np.argmax(n_coherent))
    return cause if n_coherent[cause] >= _FEWEST_COHERENT else None


def _simulated(subject: Subject) -> list[Dataset]:
    """The logs with the identified model's free runs as outputs; none where one diverges."""
    runs = [run for _, run in (*subject.training, *subject.validation)]
    if not all(np.isfinite(run).all() for run in runs):
        return []
    return [
        replace(record, outputs=np.where(np.isfinite(record.outputs), run, np.nan))
        for record, run in zip(subject.records, runs, strict=True)
    ]


def _linear_responses(
    subject: Subject, frequency: FloatArray
) -> tuple[dict[str, ComplexArray], str]:
    """Of the identified model linearised, by operating point; what has none, in a sentence."""
    curves, lacking = {}, []
    for name, linear in subject.linear.items():
        response = None if linear is None else _linear_response(subject, linear, frequency)
        if response is not None:
            curves[name] = response
        else:
            lacking.append(name)
    why = "the model has no equilibrium there, or no derivatives at it"
    return curves, f" Not drawn is {'; '.join(lacking)}: {why}." if lacking else ""


def _linearised(subject: Subject, u: FloatArray, held: Mapping[str, float]) -> LinearModel | None:
    """At constant inputs u; None where there is no equilibrium or no slope."""
    model, p = subject.model, subject.vector
    try:
        with time_limit(AT_LENGTH):
            linear = linearize(model, equilibrium(model, u, p, hold=dict(held)), u, p)
    except (ModelError, ArithmeticError, TimeoutError, ValueError, np.linalg.LinAlgError):
        return None
    return linear if all(np.isfinite(matrix).all() for matrix in linear) else None


def _linear_response(
    subject: Subject, linear: LinearModel, frequency: FloatArray
) -> ComplexArray | None:
    """From samples to samples; None where it is singular."""
    holds = [signal.hold for signal in subject.model.inputs]
    try:
        response = sampled_response(linear, frequency, subject.records[0].dt, holds)
    except (ModelError, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None  # the other curves say what there is
    return response if np.isfinite(response).all() else None


def _memory(subject: Subject) -> float:
    """Until the slowest mode of the linearised model has decayed [s]; 0 if none is known to."""
    matrices = [linear.A for linear in subject.linear.values() if linear is not None]
    rates = [rate for A in matrices for rate in (-np.linalg.eigvals(A).real).tolist() if rate > 0.0]
    return _DECAYED / min(rates) if rates else 0.0


def _plots_of_model(subject: Subject) -> Iterator[Picture]:
    """Plots that the process model brings along."""
    plots = subject.model.plots
    if plots is None:
        yield from _loops(subject)
        return
    log = {} if subject.foreign else _columns(subject.training[0][0])
    records = [logged.dataset for logged, _ in subject.training]

    def drawn(model: ProcessModel, evidence: Evidence) -> list[Plot]:
        return list(plots(model, evidence))

    evidence = Evidence(subject.vector, records, log, _draws(subject))
    for item in _by_model(subject.model, drawn, evidence):
        yield Picture(
            item.name, item.topic, item.caption,
            plot(
                {axis.name: axis.unit for axis in item.over},
                Axis(item.quantity.name, item.quantity.unit),
                {curve.label: curve.values for curve in item.curves}, item.points,
                {curve.label: curve.band for curve in item.curves if curve.band is not None},
                {curve.label: curve.beyond for curve in item.curves if curve.beyond is not None},
            ),
        )  # fmt: skip


def _draws(subject: Subject) -> FloatArray:
    """Parameters drawn from their covariance, (n_draws, n_parameters); none where there is none."""
    model, covariance = subject.model, subject.document.get("covariance") or {}
    columns = covariance.get("parameters") or ()
    names = [name for name in columns if name in model.parameter_names]
    # Behind the parameters stand states at the start of a log.
    rows = np.reshape(
        np.array(covariance.get("factor") or [], np.float64), (-1, max(len(columns), 1))
    )
    factor = rows[:, : len(names)]
    return plausible_parameters(model, subject.vector, names, factor, _DRAWS, seed=0)


def _loops(subject: Subject) -> Iterator[Picture]:
    """Forces and torques over the motion, of a model that brings no figures of its own."""
    log, run = subject.training[0][0].dataset, subject.training[0][1]
    model = subject.model
    inputs = {s.name: (s.unit, log.inputs[:, k]) for k, s in enumerate(model.inputs)}
    measured = inputs | {s.name: (s.unit, log.outputs[:, k]) for k, s in enumerate(model.outputs)}
    simulated = inputs | {s.name: (s.unit, run[:, k]) for k, s in enumerate(model.outputs)}
    for name, (unit, _) in measured.items():
        over = {n: u for n, (u, _) in measured.items() if u in _MOTIONS.get(unit, ())}
        if not over or not any(s.name in (name, *over) for s in model.outputs):
            continue
        runs = {"measured": measured, "identified": simulated}
        yield Picture(
            _stem("loop", name), "torque",
            f"{name} over {' and over '.join(over)} in the training log {log.name}, as measured "
            "and of the identified model, simulated freely.",
            plot(
                over, Axis(name, unit),
                {label: {n: values[n][1] for n in (name, *over)} for label, values in runs.items()},
            ),
        )  # fmt: skip


def _by_model(
    model: ProcessModel, function: Callable[[ProcessModel, Given], Drawn], given: Given
) -> Drawn:
    """What a model's own function returns; ConfigError where it fails or does not end."""
    try:
        with time_limit(AT_LENGTH):
            return function(model, given)
    except Exception as error:
        problem = f"model {model.name}: its figures fail: {type(error).__name__}: {error}"
        raise ConfigError(problem, cure="mend them, or give --no-report") from error


def _chosen(logs: Sequence[FreeRun]) -> list[tuple[int, str]]:
    """Logs to show and their labels: all if they are few, else the middle, worst and best."""
    n = len(logs)
    if n <= _LOGS_A_PART:
        return [(k, f"log {k + 1} of {n}" if n > 1 else "") for k in range(n)]
    fits = [float(mean_known(evaluate(log.dataset.outputs, run).fit)) for log, run in logs]
    order = [int(k) for k in np.argsort(fits)]
    chosen = zip((n // 2, 0, n - 1), ("middle", "worst", "best"), strict=True)
    return [(order[place], f"{word} of {n} logs") for place, word in chosen]


def _stem(*words: str) -> str:
    """A file name made of words, with only characters that every file system takes."""
    return "-".join(re.sub(r"[^\w.]+", "-", word) for word in words if word)


def _foreign_signals(model: ProcessModel, data: Dataset) -> tuple[FloatArray, list[Panel]]:
    """Time and panels of the model's inputs and outputs in a foreign log."""
    panels = [
        Panel(signal.name, signal.unit, {"": values}, steps=signal.hold == "zoh")
        for signal, values in zip(model.inputs, data.inputs.T, strict=True)
    ]
    measured = zip(model.outputs, data.outputs.T, strict=True)
    panels += [Panel(signal.name, signal.unit, {"": values}) for signal, values in measured]
    return data.time, panels


def _capture_signals(log: LoggedRecord) -> tuple[FloatArray, list[Panel]]:
    """Time and panels of a capture: commands as asked and as applied, then the sensors."""
    columns = _columns(log)
    panels: list[Panel] = []
    for name, unit in UNITS.items():
        channel = name.removeprefix("cmd_")
        if channel != name:
            lines = {"asked": columns[name], "applied": columns[f"applied_{channel}"]}
            panels.append(Panel(channel, unit, lines, steps=True))
        elif name != "t" and not name.startswith("applied_"):
            panels.append(Panel(name, unit, {"": columns[name]}))
    return columns["t"], panels


def _columns(log: LoggedRecord) -> dict[str, FloatArray]:
    """Columns of a capture's log by name."""
    columns = load(log.path).columns
    return {name: columns[name].astype(np.float64) for name in UNITS}


def draw_replay(replays: Sequence[Replay], path: Path) -> None:
    """Measured outputs, and those that one or several models simulate, in a figure at a path.

    Raises ConfigError for an unknown format, RunError if the file cannot be written.
    """
    first = replays[0]
    labels = short_names(replays) if len(replays) > 1 else ["simulated"]
    outputs = []
    for j, output in enumerate(first.model.outputs):
        lines = {"measured": first.measured[:, j]}
        lines |= {k: r.simulated[:, j] for k, r in zip(labels, replays, strict=True)}
        fits = [_percent(replay.metrics.fit[j]) for replay in replays]
        named = [f"{label} {fit}" for label, fit in zip(labels, fits, strict=True)]
        note = f"fit: {', '.join(named)}" if len(fits) > 1 else f"fit {fits[0]}"
        outputs.append(Panel(output.name, output.unit, lines, note=note))
    kind = style.format_of(path)
    write_whole(path, style.render(responses(first.time, outputs), kind))
