"""What the commands do, as functions that take and give pandas tables."""

from __future__ import annotations

import json
from collections.abc import Mapping as MappingType
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from daq.cli.identify import assemble, refuse_overlap, write_parameters
from daq.cli.replay import Replay, columns_of, replay_values, told_parameters
from daq.errors import ConfigError
from daq.identification import records as datasets
from daq.identification.records import Loaded, Mapping
from daq.identification.result import NOTES, Identified, document
from daq.identification.settings import Prepared, gassi_settings, prepare
from daq.logs.recording import Recording, load
from daq.lookup.experiments import load_experiment
from daq.lookup.rigs import DEFAULT_RIG, load_rig, rig_for
from daq.run.runner import run_experiment
from sysid import GASSI, ModelError, ProcessModel

_ERRORS = ("rmse", "msd", "fit_percent")

if TYPE_CHECKING:
    import pandas as pd

    Source = str | Path | Recording | pd.DataFrame


def record(
    experiment: str | Path,
    rig: str | Path | None = None,
    out: str | Path = "runs",
    validation: bool = False,
    options: MappingType[str, Any] | None = None,
) -> Recording:
    """Run an experiment on a rig; what it logged, ``frame`` as a table.

    Files as for ``rig run``, shipped ones among them. validation: the experiment with what its
    ``validation`` section changes. options: of the rig's backend, over those of its file. Raises
    RigError with cause and cure; outputs are zero then.
    """
    loaded = load_experiment(str(experiment))
    if validation:
        changed = loaded.validation()
        if changed is None:
            raise ConfigError(f"{loaded.file.path}: it has no 'validation' section; add one")
        loaded = changed
    config, device = load_rig(str(rig or rig_for(str(experiment))), options)
    loaded.plan(config)
    result = run_experiment(loaded.experiment, loaded.name, config, device, Path(out))
    return load(result.folder)


@dataclass(frozen=True)
class Identification:
    """Parameters found from logs, and how far to trust them.

    result: everything, as the command's report is made from it.
    """

    result: Identified

    @property
    def trust(self) -> str:
        """The verdict in one word."""
        return self.result.verdict.trust

    @property
    def reasons(self) -> tuple[str, ...]:
        """What the verdict rests on."""
        return tuple(self.result.verdict.reasons)

    @cached_property
    def document(self) -> dict[str, Any]:
        """What ``rig identify --json`` prints."""
        return document(self.result)

    @property
    def parameters(self) -> pd.DataFrame:
        """A row for each parameter: value, low and high end of its 95 % interval, unit.

        NaN where there is no interval, and why as a note: such a parameter is not to be used by
        itself.
        """
        import pandas as pd

        rows = {}
        for name, entry in self.document["parameters"].items():
            low, high = entry.get("interval") or (float("nan"), float("nan"))
            note = NOTES[entry.get("undetermined", "")]
            rows[name] = {
                "value": entry["value"], "low": low, "high": high, "unit": entry["unit"],
                "note": note,
            }  # fmt: skip
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")

    @property
    def metrics(self) -> pd.DataFrame:
        """Errors of the free runs, a row for each part, log and output.

        rmse and msd in parts of the largest measured value, fit_percent 100 for a perfect one.
        """
        import pandas as pd

        rows = [
            {"part": part, "log": log["name"], "output": output, **{n: errors[n] for n in _ERRORS}}
            for part, logs in self.document["metrics"].items()
            for log in logs
            for output, errors in log["outputs"].items()
        ]
        return pd.DataFrame(rows).set_index(["part", "log", "output"])

    def save(self, folder: str | Path) -> Path:
        """Write ``parameters.yaml`` into a folder; its path. Raises ConfigError."""
        return write_parameters(Path(folder), self.document)


def identify(
    logs: Source | Sequence[Source],
    validate: Source | Sequence[Source] = (),
    model: str | None = None,
    config: str | Path | None = None,
    **settings: Any,
) -> Identification:
    """One parameter set from logs, as ``rig identify`` finds it.

    logs, validate: run folders, CSV files, recordings, or tables with a column ``t`` [s] and one
    for each of the model's inputs and outputs. model: a name or ``file.py:object``. config: a file
    of settings; settings: keys of such a file. Raises ConfigError with cause and cure.
    """
    told = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    prepared = prepare(Path(config) if config is not None else None, {"model": model}, told)
    train = _loaded(logs, "training", prepared)
    check = _loaded(validate, "validation", prepared)
    refuse_overlap(train, check)
    train, ends = datasets.hold_back(train, prepared.settings.hold_back)
    return Identification(_fitted(prepared, train, [*ends, *check]))


def replay(
    log: Source,
    parameters: Identification | str | Path | None = None,
    rig: str | Path = DEFAULT_RIG,
    config: str | Path | None = None,
) -> Replay:
    """A log's inputs through a model with given parameters, as ``rig replay`` does it.

    parameters: an identification or its ``parameters.yaml``; default the simulated rig's own.
    Raises ConfigError.
    """
    if isinstance(parameters, Identification):
        model = parameters.result.model
        values, source = dict(parameters.result.estimator.parameters_), "identification"
    else:
        path = Path(parameters) if parameters is not None else None
        model, values, source = told_parameters(str(rig), path)
    mapping = columns_of(Path(config) if config is not None else None, model)
    return replay_values(_take(log, "data", model, mapping), model, values, source)


def _loaded(given: Source | Sequence[Source], name: str, prepared: Prepared) -> list[Loaded]:
    sources = _sources(given)
    labels = [f"{name} {k}" for k in range(1, len(sources) + 1)] if len(sources) != 1 else [name]
    return [
        _take(source, label, prepared.model, prepared.mapping)
        for source, label in zip(sources, labels, strict=True)
    ]


def _sources(given: Source | Sequence[Source]) -> list[Source]:
    """Each log by itself; a folder without a log.csv stands for the CSVs in it."""
    if isinstance(given, list | tuple):
        return [one for each in given for one in _sources(each)]
    if isinstance(given, str | Path):
        return [*datasets.expand([Path(given)])]
    return [cast("Source", given)]


def _take(source: Source, name: str, model: ProcessModel, mapping: Mapping | None) -> Loaded:
    """A record from whatever holds one; name: of a table, which has none of its own."""
    if isinstance(source, str | Path):
        return datasets.load(Path(source), model, mapping)
    if mapping is not None:
        raise ConfigError(
            f"{mapping.file.path}: its 'columns' are those of files; rename a table's columns "
            "to the model's signals instead, and leave them out"
        )
    try:
        if isinstance(source, Recording):
            return datasets.from_recording(source, model)
        return datasets.from_frame(source, name, model)
    except ModelError as error:
        raise ConfigError(f"{name}: {error}") from None


def _fitted(prepared: Prepared, train: list[Loaded], check: list[Loaded]) -> Identified:
    try:
        estimator = GASSI(prepared.model, **gassi_settings(prepared.settings))
        estimator.fit([log.dataset for log in train])
    except ModelError as error:
        raise ConfigError(str(error)) from None
    return assemble(prepared, estimator, train, check, quiet=True)
