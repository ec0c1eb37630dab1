"""From a finished identification to its figures: which are drawn, of which arrays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.figures.bode import ComplexArray, Measured, bode
from daq.figures.convergence import convergence
from daq.figures.loops import Loop, hysteresis_loops
from daq.figures.parameters import Determined, Searched, correlation, intervals, ranges
from daq.figures.picture import Picture
from daq.figures.residuals import Remainder, residual_correlations
from daq.figures.responses import Response, responses
from daq.figures.signals import Panel, signals
from daq.figures.spectra import Spectrum, spectra
from daq.identification.records import Loaded
from daq.identification.result import NOTES
from daq.logs.columns import UNITS
from daq.logs.recording import load
from sim_rig import torque_loops as resisting
from sysid import Dataset, ModelError, equilibrium, evaluate, linearize
from sysid.arrays import BoolArray, FloatArray
from sysid.judging.residual_tests import residual_test
from sysid.problem.metrics import mean_known
from sysid.problem.model import ProcessModel
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
    training: Sequence[Loaded]
    validation: Sequence[Loaded]
    training_runs: Sequence[Run]
    validation_runs: Sequence[Run]
    foreign: bool
    baselines: Mapping[str, Sequence[Run]]

    @property
    def vector(self) -> FloatArray:
        """All parameters, in the model's order."""
        found = self.document["parameters"]
        return np.array([float(found[name]["value"]) for name in self.model.parameter_names])


def pictures(subject: Subject) -> Iterator[Picture]:
    """One figure after the other, as they are drawn."""
    yield from _validation(subject)
    yield from _training(subject)
    yield from _excitation(subject)
    yield from _residuals(subject)
    yield from _search(subject.document)
    yield from _parameters(subject.document)
    yield from _frequency(subject)
    yield from _torque(subject)


def _validation(subject: Subject) -> Iterator[Picture]:
    runs, logs = subject.validation_runs, subject.validation
    against = "".join(f" and {name}" for name in subject.baselines)
    for place, word in _chosen(subject.model, logs, runs):
        simulated = {"identified": runs[place]}
        simulated |= {name: own[place] for name, own in subject.baselines.items()}
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
    model: ProcessModel, log: Dataset, simulated: Mapping[str, Run], part: str, word: str,
    caption: str,
) -> Iterator[Picture]:  # fmt: skip
    which = f"{log.name}, {word}" if word else log.name
    for first in range(0, len(model.outputs), _OUTPUTS_A_FIGURE):
        some = range(first, min(first + _OUTPUTS_A_FIGURE, len(model.outputs)))
        more = f"from-{model.outputs[first].name}" if first else ""
        yield Picture(
            _stem(part, word, more),
            "responses",
            caption.format(log=which),
            responses(log.time, [_response(model, log, simulated, j) for j in some]),
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
    found = residual_test(data.outputs - run, data.inputs, data.input_noise)
    names = subject.model.input_names
    remainders = [
        Remainder(
            output.name, found.auto[:, j], float(found.auto_band[j]),
            {names[i]: (found.cross[:, j, i], float(found.cross_band[j, i]))
             for i in range(len(names)) if found.tested[i]},
        )
        for j, output in enumerate(subject.model.outputs)
    ]  # fmt: skip
    yield Picture(
        "residuals", "residuals",
        f"Correlation of the residuals ({data.name}) with their own past and with past inputs, in "
        "parts of the 95 % band (grey): a model that explains all but white noise stays inside.",
        residual_correlations(np.asarray(found.lags * data.dt), remainders),
    )  # fmt: skip


def _search(document: Mapping[str, Any]) -> Iterator[Picture]:
    search = document["search"]
    history = np.asarray(search["history"], dtype=np.float64)
    before = float(document["error"]["before_refinement"])
    refined = len(history) and float(history[-1]) < before
    yield Picture(
        "convergence", "search",
        "Convergence of the search: the best error against simulations spent"
        + (". A genetic search over the whole range comes first, local least squares from its "
           "best points then." if refined else "."),
        convergence(history, int(search["population"]), before if refined else None),
    )  # fmt: skip


def _parameters(document: Mapping[str, Any]) -> Iterator[Picture]:
    free = {name: one for name, one in document["parameters"].items() if "range" in one}
    if free:
        yield Picture(
            "ranges", "parameters",
            "Every free parameter in the range that it was searched in. Open circles have no "
            "interval: the data do not determine these by themselves.",
            ranges([_searched(name, one) for name, one in free.items()]),
        )  # fmt: skip
    own = [name for name, one in free.items() if "interval" in one]
    combined = [one for a in document.get("ambiguities", []) for one in a["determined"]]
    quantities = [{"name": name, **free[name]} for name in own] + combined
    if quantities:
        yield Picture(
            "intervals", "parameters",
            "95 % intervals of all that the data determine: parameters by themselves, and "
            "combinations of those that act only together.",
            intervals([Determined(q["name"], q["value"], *q["interval"]) for q in quantities]),
        )  # fmt: skip
    if len(own) > 1:
        yield Picture(
            "correlation", "parameters",
            "Correlation of the estimates that have an interval of their own. ±1 means that one "
            "is known only as well as the other.",
            correlation(own, _correlations(own, document["correlations"])),
        )  # fmt: skip


def _searched(name: str, one: Mapping[str, Any]) -> Searched:
    low, high = one["range"]
    return Searched(
        name, one["unit"], one["value"], low, high, one["scale"] == "log",
        tuple(one["interval"]) if "interval" in one else None,
        NOTES[one.get("undetermined", "bound" if one["on_bound"] else "")],
    )  # fmt: skip


def _correlations(names: Sequence[str], pairs: Sequence[Mapping[str, Any]]) -> FloatArray:
    matrix = np.full((len(names), len(names)), np.nan)
    np.fill_diagonal(matrix, 1.0)
    for pair in pairs:
        if all(name in names for name in pair["parameters"]):
            i, j = (names.index(name) for name in pair["parameters"])
            matrix[i, j] = matrix[j, i] = pair["correlation"]
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
    found = {}
    if all(np.isfinite(run).all() for run in runs):
        simulated = [
            replace(record, outputs=np.where(np.isfinite(record.outputs), run, np.nan))
            for record, run in zip(records, runs, strict=True)
        ]
        found["identified"] = frequency_response(simulated).response
    u = np.concatenate([record.inputs for record in records]).mean(axis=0)
    for name, held in _operating_points(subject.model, records).items():
        response = _linear_response(subject, u, held, frequency, records[0].dt)
        if response is not None:
            found[name] = response
    return found


def _linear_response(
    subject: Subject, u: FloatArray, held: dict[str, float], frequency: FloatArray, dt: float
) -> ComplexArray | None:
    """The model linearised under constant inputs; None where it has no such operating point."""
    model, p = subject.model, subject.vector
    try:
        linear = linearize(model, equilibrium(model, u, p, hold=held), u, p)
        response = sampled_response(linear, frequency, dt, [i.hold for i in model.inputs])
    except (ModelError, ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None  # singular there; the other curves say what there is
    return response if np.isfinite(response).all() else None


def _operating_points(
    model: ProcessModel, records: Sequence[Dataset]
) -> dict[str, dict[str, float]]:
    """States to hold, by what the operating point is called."""
    if not ("omega" in model.state_names and "omega" in model.output_names):
        return {"linear, mean inputs": {}}
    outputs = np.concatenate([record.outputs for record in records])
    speeds = outputs[:, model.output_names.index("omega")]
    speed = float(np.sqrt(np.nanmean(speeds**2)))
    still = {name: 0.0 for name in ("theta",) if name in model.state_names}
    return {
        "linear, ω = 0": {"omega": 0.0, **still},
        f"linear, ω = {speed:.3g} rad/s": {"omega": speed, **still},
    }


def _torque(subject: Subject) -> Iterator[Picture]:
    loops = resisting.loops(subject.model, subject.vector, _swing(subject))
    if loops:
        yield Picture(
            "hysteresis", "torque",
            "Torque that resists the shaft in the identified model, driven at a sinusoidal speed "
            "with the brake's current held: over the angle, and over the speed.",
            hysteresis_loops(loops),
        )  # fmt: skip
    measured = [] if subject.foreign else _measured_torque(subject.training[0])
    if measured:
        yield Picture(
            "torque-velocity", "torque",
            "Torque at the sensor as measured in the training log, over the angle and over the "
            "speed.",
            hysteresis_loops(measured, points=True),
        )  # fmt: skip


def _swing(subject: Subject) -> resisting.Swing:
    """A sinusoidal speed as fast as the logs', and currents within what was measured."""
    names = subject.model.output_names
    outputs = np.concatenate([log.dataset.outputs for log in subject.training])

    def largest(name: str) -> float:
        if name not in names:
            return 0.0
        return float(np.nanquantile(np.abs(outputs[:, names.index(name)]), 0.98))

    return resisting.Swing(largest("omega"), largest("current_brake"))


def _chosen(
    model: ProcessModel, logs: Sequence[Loaded], runs: Sequence[Run]
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


def _pairs(found: FrequencyResponse) -> list[tuple[int, int]]:
    """For each output the input seen best in it, where one is seen at all."""
    seen = np.sum(found.coherence > _FELT, axis=0)
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


def _capture_signals(log: Loaded) -> Figure:
    """All channels: commands with what was applied of them, then the sensors."""
    frame = load(log.path).frame
    known = {name: frame[name].to_numpy(dtype=np.float64) for name in UNITS if name in frame}
    time = known.pop("t")
    panels = []
    for name in [name for name in known if name.startswith("cmd_")]:
        applied = known.get(name.replace("cmd_", "applied_"))
        lines = {"asked": known[name]} | ({} if applied is None else {"applied": applied})
        panels.append(Panel(name.removeprefix("cmd_"), UNITS[name], lines, steps=True))
    sensors = [name for name in known if not name.startswith(("cmd_", "applied_"))]
    panels += [Panel(name, UNITS[name], {"": known[name]}) for name in sensors]
    return signals(time, panels)


def _measured_torque(log: Loaded) -> list[Loop]:
    """Torque of a capture over angle and speed, apart by whether the brake's current is high."""
    frame = load(log.path).frame
    if not {"theta", "omega", "torque", "current_brake"} <= set(frame):
        return []
    current = frame["current_brake"].to_numpy(dtype=np.float64)
    middle = 0.5 * (float(np.nanmin(current)) + float(np.nanmax(current)))

    def loop(word: str, rows: BoolArray) -> Loop:
        angle, speed, torque = (
            frame[name].to_numpy(dtype=np.float64)[rows] for name in ("theta", "omega", "torque")
        )
        return Loop(f"brake {word} {middle:.2g} A", angle, speed, torque)

    return [loop("below", current < middle), loop("above", current >= middle)]
