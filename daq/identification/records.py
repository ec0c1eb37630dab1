"""From log files to the records a process model is fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.config.check import refuse
from daq.config.identification import Column, Columns
from daq.config.units import factor
from daq.config.yaml_file import Key, YamlFile
from daq.errors import ConfigError, suggestion
from daq.hal import FloatArray, IntArray
from daq.logs.capture import LOG_NAME
from daq.logs.recording import Recording, end_of_run, log_path, read_record
from daq.logs.recording import load as load_recording
from daq.logs.table import column_names, read_table
from daq.logs.time_base import require_rows, time_base
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ModelError, Output, ProcessModel

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ColumnMapping:
    """The 'columns' section of a configuration file, checked against a model."""

    file: YamlFile
    columns: Columns


@dataclass(frozen=True)
class LoggedRecord:
    """A log as a record for a model; warning: how a run that did not complete ended."""

    dataset: Dataset
    path: Path
    warning: str | None


def expand(paths: list[Path]) -> list[Path]:
    """Logs named on the command line: a folder without a log.csv stands for the CSVs in it."""
    logs: list[Path] = []
    for path in paths:
        if path.is_dir() and not (path / LOG_NAME).exists():
            inside = sorted(path.glob("*.csv"))
            if not inside:
                raise ConfigError(
                    "neither a capture folder (with log.csv) nor a folder of CSV files", file=path
                )
            logs += inside
        else:
            logs.append(path)
    return logs


def load(path: Path, model: ProcessModel, mapping: ColumnMapping | None) -> LoggedRecord:
    """One log as a record; ConfigError names the file, line and column of what is wrong."""
    try:
        if mapping is not None:
            return _load_foreign(log_path(path), model, mapping)
        return from_recording(load_recording(path), model)
    except ModelError as error:
        raise ConfigError(str(error), file=path) from None


def from_recording(recording: Recording, model: ProcessModel) -> LoggedRecord:
    """A log that has been read as a record; ConfigError, ModelError."""
    dataset = _with_noise(_from_log(recording, model, recording.name), recording, model)
    return LoggedRecord(dataset, recording.path, recording.warning)


def from_frame(frame: pd.DataFrame, name: str, model: ProcessModel) -> LoggedRecord:
    """A table with time ``t`` [s] and the model's signals by name; ConfigError, ModelError."""
    path, wanted = Path(name), ("t", *model.input_names, *model.output_names)
    for column in wanted:
        if column not in frame:
            raise ConfigError(
                f"model {model.name} needs the column {column!r}",
                cure=f"the table has {', '.join(map(str, frame.columns))}. Rename or add it",
                file=name,
            )
    require_rows(path, len(frame))
    try:
        numbers = frame.loc[:, list(wanted)].astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"a column is not of numbers: {error}", file=name) from None
    tick, dt = time_base(path, numbers["t"].to_numpy(), first_line=0)
    log = Recording(path, numbers.assign(tick=tick), dt)
    return LoggedRecord(_from_log(log, model, name), path, None)


def hold_back(
    logs: list[LoggedRecord], part: float
) -> tuple[list[LoggedRecord], list[LoggedRecord]]:
    """The beginnings of logs, to train on, and the last ``part`` of each, to validate by.

    An end starts where every output was measured, so that its first sample tells where it
    starts. Raises ConfigError when a beginning or an end holds too little.
    """
    if part == 0.0:
        return logs, []
    halves = [_halves(log, part) for log in logs]
    return [half[0] for half in halves], [half[1] for half in halves]


def _halves(log: LoggedRecord, part: float) -> tuple[LoggedRecord, LoggedRecord]:
    whole = log.dataset
    cut = round(whole.n_samples * (1.0 - part))
    complete = np.flatnonzero(np.all(np.isfinite(whole.outputs[cut:]), axis=1))
    begin = cut + int(complete[0]) if len(complete) else cut
    shares = (f"first {100 * (1 - part):.3g} %", f"last {100 * part:.3g} %")
    halves = []
    for (first, last), share in zip(((0, cut), (begin, whole.n_samples)), shares, strict=True):
        measured = np.isfinite(whole.outputs[first:last]).any(axis=0)
        if last - first < 2 or not measured.all():
            raise ConfigError(
                f"with hold_back {part:g} the {share} of it hold "
                f"{last - first} "
                f"samples{'' if measured.all() else ' and miss an output'}",
                cure="hold back another part, or validate with another log",
                file=log.path,
            )
        dataset = whole.part(first, last, f"{whole.name} ({share})")
        halves.append(replace(log, dataset=dataset))
    return halves[0], halves[1]


def check_mapping(
    model: ProcessModel, mapping: ColumnMapping, spare: dict[str, tuple[str, ...]]
) -> None:
    """Raise ConfigError unless every signal of the model, and no other, has its column.

    spare: ``inputs`` and ``outputs`` that may have one as well though this model is used without
    them.
    """
    groups = (
        ("inputs", mapping.columns.inputs, model.input_names),
        ("outputs", mapping.columns.outputs, model.output_names),
    )
    for group, given, needed in groups:
        for name in given:
            if name not in needed and name not in spare[group]:
                raise mapping.file.error(
                    ("columns", group, name),
                    f"model {model.name} has no such signal; {suggestion(name, needed)}",
                )
        for name in needed:
            if name not in given:
                raise mapping.file.error(
                    ("columns", group), f"{name!r} of model {model.name} is missing; add it"
                )
    for name, column in mapping.columns.outputs.items():
        if column.constant is not None:
            raise mapping.file.error(
                ("columns", "outputs", name), "an output must be measured, not constant"
            )
    for group, given, signals in (
        ("inputs", mapping.columns.inputs, [(s.name, s.unit) for s in model.inputs]),
        ("outputs", mapping.columns.outputs, [(s.name, s.unit) for s in model.outputs]),
    ):
        for name, unit in signals:
            unit_factor(mapping.file, ("columns", group, name, "unit"), given[name].unit, unit)


def _from_log(log: Recording, model: ProcessModel, title: str) -> Dataset:
    columns = list(log.frame.columns)
    for name in (*model.input_names, *model.output_names):
        if name not in columns:
            raise ConfigError(
                f"model {model.name} needs {name!r}, which is no column of this log",
                cure=(
                    f"{suggestion(name, columns)} Name the column in the "
                    "'columns' section of a file given with --config"
                ),
                file=log.path,
            )
    inputs = log.frame[list(model.input_names)].to_numpy(dtype=np.float64)
    outputs = log.frame[list(model.output_names)].to_numpy(dtype=np.float64)
    tick = log.frame["tick"].to_numpy()
    return _dataset(log.path, model, inputs, outputs, tick, log.dt, title)


def _with_noise(dataset: Dataset, recording: Recording, model: ProcessModel) -> Dataset:
    """The record with what its offset calibration told of noise and zeros."""
    inputs = np.array([recording.noise(name) for name in model.input_names]).reshape(-1, 2)
    outputs = np.array([recording.noise(name) for name in model.output_names]).reshape(-1, 2)
    return replace(
        dataset, input_noise=inputs[:, 0], input_zero=inputs[:, 1], output_zero=outputs[:, 1]
    )


def _load_foreign(path: Path, model: ProcessModel, mapping: ColumnMapping) -> LoggedRecord:
    columns = mapping.columns
    _check_columns(path, model, mapping)
    inputs_from = {columns.inputs[name].column for name in model.input_names}
    outputs_from = {columns.outputs[name].column for name in model.output_names}
    gapless = {columns.time.column, *inputs_from}
    used = sorted(name for name in gapless | outputs_from if name is not None)
    frame, first_line, torn = read_table(
        path,
        used,
        "mend these cells or remove their lines (removed lines count as lost samples)",
        gaps=[name for name in used if name not in gapless],
    )
    require_rows(path, len(frame))
    tick, dt = _foreign_time(path, frame, first_line, mapping)

    def values(signal: Input | Output, group: str, source: Column) -> FloatArray:
        key = ("columns", group, signal.name, "unit")
        factor = source.sign * unit_factor(mapping.file, key, source.unit, signal.unit)
        if source.column is None:
            assert source.constant is not None
            return np.full(len(frame), source.constant * factor)
        return np.asarray(frame[source.column].to_numpy() * factor)

    inputs = [values(s, "inputs", columns.inputs[s.name]) for s in model.inputs]
    outputs = np.stack(
        [values(s, "outputs", columns.outputs[s.name]) for s in model.outputs], axis=1
    )
    # The first sample tells where the model starts.
    begin = int(np.argmax(np.isfinite(outputs).all(axis=1)))
    dataset = _dataset(
        path,
        model,
        (np.stack(inputs, axis=1) if inputs else np.zeros((len(frame), 0)))[begin:],
        outputs[begin:],
        tick[begin:],
        dt,
        path.stem,
    )
    return LoggedRecord(dataset, path, end_of_run(path, read_record(path), torn))


def _check_columns(path: Path, model: ProcessModel, mapping: ColumnMapping) -> None:
    """Raise ConfigError at each key that names a column which a file does not have."""
    present = column_names(path)
    columns = mapping.columns
    wanted: list[tuple[Key, str | None]] = [(("columns", "time", "column"), columns.time.column)]
    for group, given, names in (
        ("inputs", columns.inputs, model.input_names),
        ("outputs", columns.outputs, model.output_names),
    ):
        wanted += [(("columns", group, name, "column"), given[name].column) for name in names]
    refuse(
        [
            mapping.file.mistake(
                key,
                f"{path} has no column {name!r}; {suggestion(name, list(filter(None, present)))}",
            )
            for key, name in wanted
            if name is not None and name not in present
        ]
    )


def _foreign_time(
    path: Path, frame: pd.DataFrame, first_line: int, mapping: ColumnMapping
) -> tuple[IntArray, float]:
    """Sequence numbers and sample time [s] of a foreign table's rows."""
    time = mapping.columns.time
    if time.column is None:
        assert time.sample_rate is not None
        return np.arange(len(frame), dtype=np.int64), 1.0 / time.sample_rate
    seconds = unit_factor(mapping.file, ("columns", "time", "unit"), time.unit, "s")
    values = frame[time.column].to_numpy() * seconds
    cure = (
        "say 'grid: 0.001' (s) in 'columns: time:' to round uneven times to multiples of it, or "
        "resample the log to a constant rate"
    )
    tick = None
    if time.grid is not None:
        tick = np.round((values - values[0]) / time.grid)
        if np.any(np.diff(tick) == 0.0) and np.all(np.diff(values) > 0.0):
            raise mapping.file.error(
                ("columns", "time", "grid"),
                f"{time.grid:g} s is too coarse: rows of {path} are "
                f"{np.diff(values).min():g} s apart; take a tenth of that",
            )
        values = tick * time.grid
    return time_base(path, values, tick, first_line=first_line, column=time.column, cure=cure)


def _dataset(
    path: Path,
    model: ProcessModel,
    inputs: FloatArray,
    outputs: FloatArray,
    tick: IntArray,
    dt: float,
    name: str,
) -> Dataset:
    """A record in which lost samples keep their place: inputs go on, outputs are missing."""
    rows = tick - tick[0]
    length = int(rows[-1]) + 1
    if length > 50 * len(rows) + 1000:
        raise ConfigError(
            f"the log covers {length} sample times but holds {len(rows)} samples",
            cure="too much is missing to identify anything from it",
            file=path,
        )
    whole = np.full((length, len(model.outputs)), np.nan)
    whole[rows] = outputs
    latest = np.zeros(length, dtype=np.int64)
    latest[rows] = np.arange(len(rows))
    filled = inputs[np.maximum.accumulate(latest)]
    for column, signal in enumerate(model.inputs):
        if signal.hold != "zoh":
            filled[:, column] = np.interp(np.arange(length), rows, inputs[:, column])
    return Dataset(filled, whole, dt, name)


def unit_factor(file: YamlFile, key: tuple[str, ...], unit: str | None, wanted: str) -> float:
    """Factor from a unit in the file to the model's unit."""
    try:
        return 1.0 if unit is None else factor(unit, wanted)
    except ValueError as error:
        raise file.error(key, str(error)) from None
