"""``rig replay``: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.cli import terminal as console
from daq.cli.identification import print_metrics
from daq.cli.models import find_model
from daq.config import checking, yaml_file
from daq.config.identification import IdentificationConfig, Signals
from daq.errors import ConfigError, RunError, suggestion
from daq.files import write_whole
from daq.hal import FloatArray
from daq.identification import records as datasets
from daq.identification.quantities import in_model_units
from daq.identification.records import Loaded, Mapping
from daq.identification.settings import as_told
from daq.logs.capture import LOG_NAME
from daq.lookup.rigs import DEFAULT_RIG, load_rig
from sysid import BatchSimulator, Metrics, ModelError, evaluate, free_run
from sysid.problem.model import ProcessModel

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Replay:
    """A log's inputs through a model, beside what was measured.

    time: (n,) [s]. measured, simulated: (n, n_outputs) in the outputs' units. source: whose
    parameters. warning: how a run that did not complete ended.
    """

    path: Path
    model: ProcessModel
    source: str
    time: FloatArray
    measured: FloatArray
    simulated: FloatArray
    metrics: Metrics
    warning: str | None

    @property
    def fit(self) -> dict[str, float]:
        """Fit of each output [%]: 100 is perfect, 0 no better than its mean."""
        return self._named(self.metrics.fit)

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean squared error of each output in parts of its largest measured value."""
        return self._named(self.metrics.rmse)

    @property
    def msd(self) -> dict[str, float]:
        """Mean signed deviation of each output in parts of its largest measured value."""
        return self._named(self.metrics.msd)

    @property
    def frame(self) -> pd.DataFrame:
        """A table: ``t`` [s], each output as measured, and as ``<output>_simulated``."""
        import pandas as pd

        names = self.model.output_names
        table = {"t": self.time, **dict(zip(names, self.measured.T, strict=True))}
        for name, values in zip(names, self.simulated.T, strict=True):
            table[f"{name}_simulated"] = values
        return pd.DataFrame(table)

    def _named(self, values: FloatArray) -> dict[str, float]:
        return dict(zip(self.model.output_names, values.tolist(), strict=True))


def replay(
    log: Path, rig: str = DEFAULT_RIG, parameters: Path | None = None, config: Path | None = None
) -> Replay:
    """Simulate what a log's applied commands and measured load do to a model.

    parameters: of an identification; default those of the simulated rig. config: names the
    columns of a foreign log. Raises ConfigError.
    """
    model, values, source = told_parameters(rig, parameters)
    loaded = datasets.load(log, model, columns_of(config, model))
    return replay_values(loaded, model, values, source)


def told_parameters(
    rig: str, parameters: Path | None
) -> tuple[ProcessModel, dict[str, float], str]:
    """Model and values of an identification or else of a simulated rig, and whose they are."""
    if parameters is None:
        return *_rig_truth(rig), rig
    return *read_parameters(parameters), str(parameters)


def replay_values(
    loaded: Loaded, model: ProcessModel, values: dict[str, float], source: str
) -> Replay:
    """Simulate a record's inputs with these parameters; source: whose they are. ConfigError."""
    record = loaded.dataset
    try:
        simulated = free_run(BatchSimulator(model), model.vector(values), record)
    except ModelError as error:
        raise ConfigError(str(error)) from None
    return Replay(
        loaded.path,
        model,
        source,
        np.arange(record.n_samples, dtype=np.float64) * record.dt,
        record.outputs,
        simulated,
        evaluate(record.outputs, simulated),
        loaded.warning,
    )


def replay_command(
    log: Path,
    rig: str,
    parameters: Path | None,
    config: Path | None,
    figure: Path | None,
    fail_under: list[str],
    as_json: bool,
) -> None:
    """Replay a log, print metrics, draw both, and fail where a fit is below its bound."""
    bounds = _bounds(fail_under)
    found = replay(log, rig, parameters, config)
    unknown = [name for name in bounds if name not in found.fit]
    if unknown:
        raise ConfigError(
            f"--fail-under {unknown[0]}: model {found.model.name} has no such output; "
            f"{suggestion(unknown[0], found.model.output_names)}"
        )
    if found.warning is not None:
        console.report_warning(found.warning)
    drawn = _draw(found, figure)
    # A fit that is not a number (the simulation failed) is under any bound.
    missed = {name: least for name, least in bounds.items() if not found.fit[name] >= least}
    if as_json:
        console.print_json(_document(found, drawn, bounds, missed))
    else:
        console.print_line(
            f"{found.path} through {found.model.name} with the parameters of {found.source}"
        )
        print_metrics(found.model, found.metrics, [], "replay")
        if drawn is not None:
            console.print_line(f"Figure: {drawn}")
        if not missed:
            columns = f" --config {config}" if config is not None else ""
            given = f"rig replay ANOTHER_LOG --parameters {parameters}{columns}"
            console.print_next(given if parameters else f"rig identify {log}")
    if missed:
        raise RunError(
            f"{found.path}: "
            + "; ".join(
                f"fit of {n} is {found.fit[n]:.1f} %, below {b:g} %" for n, b in missed.items()
            )
        )


def _document(
    found: Replay, drawn: Path | None, bounds: dict[str, float], missed: dict[str, float]
) -> dict[str, Any]:
    return {
        "log": str(found.path),
        "model": found.model.name,
        "parameters": found.source,
        "outputs": {
            name: {
                "rmse": found.rmse[name],
                "msd": found.msd[name],
                "fit_percent": found.fit[name],
            }
            for name in found.model.output_names
        },
        "figure": None if drawn is None else str(drawn),
        "fail_under": bounds,
        "passed": not missed,
    }


def _bounds(texts: list[str]) -> dict[str, float]:
    """``omega=80`` as the least fit [%] of an output."""
    bounds = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            bounds[name.strip()] = float(value)
            if not math.isfinite(bounds[name.strip()]):
                raise ValueError
        except ValueError:
            raise ConfigError(
                f"--fail-under {text}: write OUTPUT=PERCENT, for example omega=80"
            ) from None
    return bounds


def _draw(found: Replay, path: Path | None) -> Path | None:
    """Measured and simulated outputs in a figure; without a path beside the log, if that can be."""
    from daq.figures import style
    from daq.figures.responses import Response, responses

    chosen = path or found.path.with_name(
        "replay.png" if found.path.name == LOG_NAME else f"{found.path.stem}-replay.png"
    )
    kind = style.format_of(chosen)
    outputs = [
        Response(output.name, output.unit, found.measured[:, j],
                 {"simulated": found.simulated[:, j]}, f"fit {found.metrics.fit[j]:.1f} %")
        for j, output in enumerate(found.model.outputs)
    ]  # fmt: skip
    try:
        write_whole(chosen, style.render(responses(found.time, outputs), kind))
    except RunError as error:
        if path is not None:
            raise ConfigError(f"{error}; or choose another with --figure FILE.png") from None
        console.report_warning(str(error))
        return None
    return chosen


def read_parameters(path: Path) -> tuple[ProcessModel, dict[str, float]]:
    """Model and parameters from a parameters.yaml, as identification writes it.

    Raises ConfigError naming line and key of what is missing or wrong.
    """
    file = yaml_file.load(path)
    name = file.content.get("model")
    if not isinstance(name, str):
        raise file.error(("model",), "this key is missing; it names the process model")
    try:
        model = find_model(name, path.parent)
    except ConfigError as error:
        raise file.error(("model",), str(error)) from None
    chosen = {key: file.content[key] for key in Signals.model_fields if key in file.content}
    model = as_told(file, checking.validate(file, Signals, chosen), model)
    entries = file.content.get("parameters")
    if not isinstance(entries, dict):
        raise file.error(("parameters",), "this key is missing; it holds 'name: value' lines")
    values = {}
    for key, entry in entries.items():
        if key not in model.parameter_names:
            hint = suggestion(str(key), model.parameter_names)
            raise file.error(
                ("parameters", str(key)), f"model {model.name} has no such parameter; {hint}"
            )
        values[key] = _value(file, ("parameters", str(key)), entry)
    return model, values


def _value(file: yaml_file.YamlFile, key: tuple[str, ...], entry: Any) -> float:
    value = entry.get("value") if isinstance(entry, dict) else entry
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise file.error(key, f"expected a number, found {value!r}")
    if not math.isfinite(value):
        raise file.error(key, f"expected a finite number, found {value}")
    return float(value)


def _rig_truth(rig: str) -> tuple[ProcessModel, dict[str, float]]:
    config, device = load_rig(rig, notify=console.report)
    if config.backend != "simulated":
        raise ConfigError(
            f"{rig}: only a simulated rig knows its own parameters; "
            "give those of an identification with --parameters"
        )
    from sim_rig.backend import SimulatedDevice

    assert isinstance(device, SimulatedDevice)
    try:
        model = device.options.plant.process_model()
    except ModelError as error:
        raise ConfigError(f"{rig}: {error}") from None
    return model, dict(zip(model.parameter_names, model.nominal, strict=True))


def columns_of(config: Path | None, model: ProcessModel) -> Mapping | None:
    """The columns of a configuration, for the model that the parameters are of.

    The file may name another, for which the columns serve as well; ConfigError where they do not.
    """
    if config is None:
        return None
    file = yaml_file.load(config)
    file, wrong = in_model_units(file, [model])
    settings = checking.validate(file, IdentificationConfig, others=wrong)
    if settings.columns is None:
        return None
    mapping = Mapping(file, settings.columns)
    # The file may be of a comparison, in which other models have other signals.
    columns = settings.columns
    datasets.check_mapping(
        model, mapping, {"inputs": tuple(columns.inputs), "outputs": tuple(columns.outputs)}
    )
    return mapping
