"""``rig replay``: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from daq.cli import console, datasets
from daq.cli.datasets import Mapping
from daq.cli.files import load_rig
from daq.cli.modelling import DEFAULT_MODEL, find_model
from daq.cli.preparing import as_told
from daq.cli.reporting import print_metrics
from daq.config import checking, yaml_file
from daq.config.identification import IdentificationConfig, Signals
from daq.config.yaml_file import suggestion
from daq.errors import ConfigError
from sysid import BatchSimulator, ModelError, evaluate, free_run
from sysid.model import ProcessModel


def replay_command(
    log: Path, rig: str, parameters: Path | None, config: Path | None, as_json: bool
) -> None:
    """Simulate what the log's inputs do to a model, and compare with what was measured."""
    if parameters is not None:
        model, values = read_parameters(parameters)
        source = str(parameters)
    else:
        model, values = _rig_truth(rig)
        source = rig
    mapping = _mapping(config, model)
    loaded = datasets.load(log, model, mapping)
    if loaded.warning is not None:
        console.report_note(loaded.warning)
    try:
        simulated = free_run(BatchSimulator(model), model.vector(values), loaded.dataset)
    except ModelError as error:
        raise ConfigError(str(error)) from None
    metrics = evaluate(loaded.dataset.outputs, simulated)
    if as_json:
        console.print_json(
            {
                "log": str(loaded.path),
                "model": model.name,
                "parameters": source,
                "outputs": {
                    name: {
                        "rmse": metrics.rmse[j],
                        "msd": metrics.msd[j],
                        "fit_percent": metrics.fit[j],
                    }
                    for j, name in enumerate(model.output_names)
                },
            }
        )
        return
    console.print_line(f"{loaded.path} through {model.name} with the parameters of {source}")
    print_metrics(model, metrics, [], "replay")


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
    config, device = load_rig(rig)
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


def _mapping(config: Path | None, model: ProcessModel) -> Mapping | None:
    """The columns of a configuration, for the model as the parameters are of."""
    if config is None:
        return None
    file = yaml_file.load(config)
    settings = checking.validate(file, IdentificationConfig)
    if settings.columns is None:
        return None
    name = find_model(settings.model or DEFAULT_MODEL, config.parent).name
    if name != model.name:
        raise ConfigError(
            f"{config}: its columns are those of model {name}, "
            f"but the parameters are of {model.name}"
        )
    mapping = Mapping(file, settings.columns)
    # The file may be of a comparison, in which other models have other signals.
    columns = settings.columns
    datasets.check_mapping(
        model, mapping, {"inputs": tuple(columns.inputs), "outputs": tuple(columns.outputs)}
    )
    return mapping
