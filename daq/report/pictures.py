"""Figures of an identification's report: which are drawn, of which arrays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.figures import style
from daq.figures.bode import ComplexArray, Measured, bode
from daq.figures.convergence import convergence
from daq.figures.parameters import Determined, Searched, correlation, intervals, ranges
from daq.figures.picture import Picture
from daq.figures.plots import plot
from daq.figures.residuals import Remainder, residual_correlations
from daq.figures.responses import Response, responses
from daq.figures.signals import Panel, signals
from daq.figures.spectra import Spectrum, spectra
from daq.files import write_whole
from daq.findings import Axis
from daq.identification.records import LoggedRecord
from daq.identification.replay import Replay
from daq.identification.rows import ParameterRow, Rows
from daq.logs.columns import UNITS
from daq.logs.recording import load
from sysid import Dataset, ModelError, equilibrium, evaluate, linearize
from sysid.arrays import FloatArray
from sysid.judging.residual_tests import residual_test
from sysid.problem.metrics import mean_known
from sysid.problem.model import ProcessModel
from sysid.problem.plots import Evidence
from sysid.response.frequency import FrequencyResponse, frequency_response, sampled_response

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OUTPUTS_A_FIGURE = 4
_LOGS_A_PART = 3  # of more logs the worst, the middle and the best are shown
_FELT, _FEWEST = 0.5, 4  # an input is seen in an output where so many coherences exceed this

Run = FloatArray
"""Outputs of a free run, (n_samples, n_outputs)."""


@dataclass(frozen=True)
class Subject:
    """What is reported on: a finished identification as its document tells it, and its logs.

    document: what ``report.json`` holds. training_runs, validation_runs: the identified model's
    free run for each log. foreign: the logs are not the program's own captures. baselines: by
    name, a free run for each validation log of what it is compared with.
    """

    model: ProcessModel
    document: Mapping[str, Any]
    training: Sequence[LoggedRecord]
    validation: Sequence[LoggedRecord]
    training_runs: Sequence[Run]
    validation_runs: Sequence[Run]
    foreign: bool
    baselines: Mapping[str, Sequence[Run]]

    @property
    def vector(self) -> FloatArray:
        """All parameters, in the model's order."""
        values = {row.name: row.value for row in self.rows.parameters}
        return np.array([float(values[name]) for name in self.model.parameter_names])

    @cached_property
    def rows(self) -> Rows:
        """The document's tables."""
        return Rows.of(self.document)


def pictures(subject: Subject) -> Iterator[Picture]:
    """One figure after the other, as they are drawn."""
    yield from _validation(subject)
    yield from _training(subject)
    yield from _excitation(subject)
    yield from _residuals(subject)
    yield from _search(subject.document)
    yield from _parameters(subject.rows)
    yield from _frequency(subject)
    yield from _plots_of_model(subject)


def _validation(subject: Subject) -> Iterator[Picture]:
    runs, logs = subject.validation_runs, subject.validation
    against = "".join(f" and {name}" for name in subject.baselines)
    for place, word in _chosen(subject.model, logs, runs):
        simulated = {"identified": runs[place]}
        simulated |= {name: free_runs[place] for name, free_runs in subject.baselines.items()}
        yield from _responses(
            subject.model, logs[place].dataset, simulated, "validation", word,
            f"Validation: data not used in the fit ({{log}}). Measured outputs, the identified "
            f"model{against} simulated freely from the inputs alone, and below each the residual, "
            "measured minus simulated.",
        )  # fmt: skip


def _training(subject: Subject) -> Iterator[Picture]:
    runs, logs = subject.training_runs, subject.training
    for place, word in _chosen(subject.model, logs, runs):
        yield from _responses(
            subject.model, logs[place].dataset, {"identified": runs[place]}, "training", word,
            "Training: data used in the fit ({log}). Measured outputs, the identified model "
            "simulated freely from the inputs alone, and below each the residual.",
        )  # fmt: skip


def _responses(
    model: ProcessModel,
    log: Dataset,
    simulated: Mapping[str, Run],
    part: str,
    word: str,
    caption: str,
) -> Iterator[Picture]:
    which = f"{log.name}, {word}" if word else log.name
    for first in range(0, len(model.outputs), _OUTPUTS_A_FIGURE):
        shown = range(first, min(first + _OUTPUTS_A_FIGURE, len(model.outputs)))
        more = f"from-{model.outputs[first].name}" if first else ""
        yield Picture(
            _stem(part, word, more),
            "responses",
            caption.format(log=which),
            responses(log.time, [_response(model, log, simulated, j) for j in shown]),
        )


def _response(model: ProcessModel, log: Dataset, simulated: Mapping[str, Run], j: int) -> Response:
    output = model.outputs[j]
    fits = {name: float(evaluate(log.outputs, run).fit[j]) for name, run in simulated.items()}
    several = len(fits) > 1
    shown = ", ".join(f"{name} " * several + f"{_percent(fit)} %" for name, fit in fits.items())
    return Response(
        output.name,
        output.unit,
        log.outputs[:, j],
        {name: run[:, j] for name, run in simulated.items()},
        f"fit{':' * several} {shown}",
    )


def _percent(fit: float) -> str:
    return f"{fit:.1f}".replace("-", "−") if np.isfinite(fit) else "–"


def _excitation(subject: Subject) -> Iterator[Picture]:
    log = subject.training[0]
    yield Picture(
        "signals", "excitation",
        f"What was commanded and measured in the training log {log.dataset.name}.",
        _foreign_signals(subject.model, log.dataset) if subject.foreign else _capture_signals(log),
    )  # fmt: skip


def _residuals(subject: Subject) -> Iterator[Picture]:
    part = (subject.validation, subject.validation_runs)
    if not subject.validation:
        part = (subject.training, subject.training_runs)
    data, run = part[0][0].dataset, part[1][0]
    if not np.isfinite(run).all():
        return
    test = residual_test(data.outputs - run, data.inputs, data.input_noise)
    names = subject.model.input_names
    remainders = [
        Remainder(
            output.name, test.auto[:, j], float(test.auto_band[j]),
            {names[i]: (test.cross[:, j, i], float(test.cross_band[j, i]))
             for i in range(len(names)) if test.tested[i]},
        )
        for j, output in enumerate(subject.model.outputs)
    ]  # fmt: skip
    yield Picture(
        "residuals", "residuals",
        f"Correlation of the residuals ({data.name}) with their own past and with past inputs, in "
        "parts of the 95 % band (grey): a model that explains all but white noise stays inside.",
        residual_correlations(np.asarray(test.lags * data.dt), remainders),
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
        "convergence",
        "search",
        "Convergence of the search: the best error against simulations spent"
        + (stages if refined else "."),
        convergence(history, int(search["population"]), before if refined else None),
    )


def _parameters(rows: Rows) -> Iterator[Picture]:
    if rows.free:
        yield Picture(
            "ranges",
            "parameters",
            "Every free parameter in the range that it was searched in. Open circles have no "
            "interval: the data do not determine these by themselves.",
            ranges([_searched(row) for row in rows.free]),
        )
    quantities = [
        Determined(row.name, row.value, *row.interval)
        for row in (*rows.determined, *rows.combinations)
        if row.interval is not None
    ]
    if quantities:
        yield Picture(
            "intervals",
            "parameters",
            "95 % intervals of all that the data determine: parameters by themselves, and "
            "combinations of those that act only together.",
            intervals(quantities),
        )
    names = [row.name for row in rows.determined]
    if len(names) > 1:
        yield Picture(
            "correlation",
            "parameters",
            "Correlation of the estimates that have an interval of their own. ±1 means that one "
            "is known only as well as the other.",
            correlation(names, _correlations(names, rows)),
        )


def _searched(row: ParameterRow) -> Searched:
    assert row.range is not None
    return Searched(
        row.name, row.unit, row.value, *row.range, row.logarithmic, row.interval, row.label
    )


def _correlations(names: Sequence[str], rows: Rows) -> FloatArray:
    matrix = np.full((len(names), len(names)), np.nan)
    np.fill_diagonal(matrix, 1.0)
    for pair, coefficient in rows.correlations.items():
        if all(name in names for name in pair):
            i, j = (names.index(name) for name in pair)
            matrix[i, j] = matrix[j, i] = coefficient
    return matrix


def _frequency(subject: Subject) -> Iterator[Picture]:
    records = [log.dataset for log in (*subject.training, *subject.validation)]
    try:
        measured = frequency_response(records)
    except ModelError:
        return  # too short, or of several sample rates: there is no estimate to show
    inputs = [
        Spectrum(signal.name, signal.unit, measured.input_density[:, i])
        for i, signal in enumerate(subject.model.inputs)
        if measured.varied[i]
    ]
    yield Picture(
        "spectra", "excitation",
        "Spectra of the excitation: power spectral density of the inputs, Welch's estimate from "
        f"{measured.n_segments} segments.",
        spectra(measured.frequency, inputs),
    )  # fmt: skip
    yield from _bode(subject, records, measured)


def _bode(
    subject: Subject, records: list[Dataset], measured: FrequencyResponse
) -> Iterator[Picture]:
    model = subject.model
    curves = _model_responses(subject, records, measured.frequency)
    for j, i in _pairs(measured):
        output, given = model.outputs[j], model.inputs[i]
        yield Picture(
            _stem("bode", output.name), "frequency",
            f"Frequency response from {given.name} to {output.name}, estimated from "
            f"{measured.n_segments} segments of the logs.",
            bode(
                measured.frequency,
                Measured(
                    measured.response[:, j, i],
                    measured.coherence[:, j, i],
                    measured.deviation[:, j, i] / np.sqrt(2.0),
                ),
                {name: response[:, j, i] for name, response in curves.items()},
                (output.unit, given.unit),
            ),
        )  # fmt: skip


def _model_responses(
    subject: Subject, records: list[Dataset], frequency: FloatArray
) -> dict[str, ComplexArray]:
    """What the identified model does: through the estimate of the logs, and linearised."""
    runs = [*subject.training_runs, *subject.validation_runs]
    curves = {}
    if all(np.isfinite(run).all() for run in runs):
        simulated = [
            replace(record, outputs=np.where(np.isfinite(record.outputs), run, np.nan))
            for record, run in zip(records, runs, strict=True)
        ]
        curves["identified"] = frequency_response(simulated).response
    u = np.concatenate([record.inputs for record in records]).mean(axis=0)
    for name, held in _operating_points(subject.model, records).items():
        response = _linear_response(subject, u, held, frequency, records[0].dt)
        if response is not None:
            curves[name] = response
    return curves


def _linear_response(
    subject: Subject, u: FloatArray, held: Mapping[str, float], frequency: FloatArray, dt: float
) -> ComplexArray | None:
    """The model linearised under constant inputs; None where it has no such operating point."""
    model, p = subject.model, subject.vector
    try:
        linear = linearize(model, equilibrium(model, u, p, hold=dict(held)), u, p)
        response = sampled_response(linear, frequency, dt, [i.hold for i in model.inputs])
    except (ModelError, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None  # singular there; the other curves say what there is
    return response if np.isfinite(response).all() else None


def _operating_points(
    model: ProcessModel, records: Sequence[Dataset]
) -> Mapping[str, Mapping[str, float]]:
    """States to hold, by the label of an operating point."""
    brought = model.operating_points(model, records) if model.operating_points else {}
    return brought or {"linear, mean inputs": {}}


def _plots_of_model(subject: Subject) -> Iterator[Picture]:
    """What the model itself brings."""
    if subject.model.plots is None:
        return
    log = {} if subject.foreign else _columns(subject.training[0])
    records = [logged.dataset for logged in subject.training]
    for item in subject.model.plots(subject.model, Evidence(subject.vector, records, log)):
        yield Picture(
            item.name,
            item.topic,
            item.caption,
            plot(
                [Axis(axis.name, axis.unit) for axis in item.over],
                Axis(item.quantity.name, item.quantity.unit),
                {curve.label: curve.values for curve in item.curves},
                item.points,
            ),
        )


def _chosen(
    model: ProcessModel, logs: Sequence[LoggedRecord], runs: Sequence[Run]
) -> list[tuple[int, str]]:
    """Which logs are shown, and as what: all of a few, else the middle, the worst, the best."""
    n = len(logs)
    if n <= _LOGS_A_PART:
        return [(k, f"log {k + 1} of {n}" if n > 1 else "") for k in range(n)]
    fits = [
        float(mean_known(evaluate(log.dataset.outputs, run).fit))
        for log, run in zip(logs, runs, strict=True)
    ]
    order = [int(k) for k in np.argsort(fits)]
    chosen = zip((n // 2, 0, n - 1), ("middle", "worst", "best"), strict=True)
    return [(order[place], f"{word} of {n} logs") for place, word in chosen]


def _stem(*words: str) -> str:
    """A file's name of what any system takes."""
    return "-".join(re.sub(r"[^\w.]+", "-", word) for word in words if word)


def _pairs(measured: FrequencyResponse) -> list[tuple[int, int]]:
    """For each output the input seen best in it, where one is seen at all."""
    seen = np.sum(measured.coherence > _FELT, axis=0)
    best = [(j, int(np.argmax(row))) for j, row in enumerate(seen)]
    return [(j, i) for j, i in best if seen[j, i] >= _FEWEST]


def _foreign_signals(model: ProcessModel, data: Dataset) -> Figure:
    """The model's signals."""
    inputs = [
        Panel(signal.name, signal.unit, {"": data.inputs[:, i]}, steps=signal.hold == "zoh")
        for i, signal in enumerate(model.inputs)
    ]
    outputs = [
        Panel(signal.name, signal.unit, {"": data.outputs[:, j]})
        for j, signal in enumerate(model.outputs)
    ]
    return signals(data.time, [*inputs, *outputs])


def _capture_signals(log: LoggedRecord) -> Figure:
    """All channels: commands with what was applied of them, then the sensors."""
    columns = _columns(log)
    time = columns.pop("t")
    panels = []
    for name in [name for name in columns if name.startswith("cmd_")]:
        applied = columns.get(name.replace("cmd_", "applied_"))
        lines = {"asked": columns[name]} | ({} if applied is None else {"applied": applied})
        panels.append(Panel(name.removeprefix("cmd_"), UNITS[name], lines, steps=True))
    sensors = [name for name in columns if not name.startswith(("cmd_", "applied_"))]
    panels += [Panel(name, UNITS[name], {"": columns[name]}) for name in sensors]
    return signals(time, panels)


def _columns(log: LoggedRecord) -> dict[str, FloatArray]:
    """Columns of a capture's log by name."""
    frame = load(log.path).frame
    return {name: frame[name].to_numpy(dtype=np.float64) for name in UNITS if name in frame}


def draw_replay(replay: Replay, path: Path) -> None:
    """Measured and simulated outputs in a figure at a path.

    Raises ConfigError for a format that there is not, RunError where the disk refuses.
    """
    outputs = [
        Response(
            output.name,
            output.unit,
            replay.measured[:, j],
            {"simulated": replay.simulated[:, j]},
            f"fit {replay.metrics.fit[j]:.1f} %",
        )
        for j, output in enumerate(replay.model.outputs)
    ]
    kind = style.format_of(path)
    write_whole(path, style.render(responses(replay.time, outputs), kind))
