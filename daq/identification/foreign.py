"""Logs of other programs: which column is which signal, and columns of several files together."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.check import refuse
from daq.config.identification import Column, Columns
from daq.config.units import factor
from daq.config.yaml_file import Key, YamlFile, dotted
from daq.errors import ConfigError, Mistake, suggestion
from daq.hal import FloatArray, IntArray
from daq.logs.table import column_names, read_table
from daq.logs.time_base import require_rows, time_base
from sysid.problem.model import Input, Output, ProcessModel
from sysid.problem.preparation import filtered, low_pass

Signal = Input | Output
SignalGroup = tuple[str, dict[str, Column], Sequence[Signal]]

_CURE = "mend these cells or remove their lines (removed lines count as lost samples)"
TIME_UNIT = ("columns", "time", "unit")
_FASTER = 1.5  # times the log's rate above which a merged file is filtered first


@dataclass(frozen=True)
class ColumnMapping:
    """The 'columns' section of a configuration file, checked against a model."""

    file: YamlFile
    columns: Columns


@dataclass(frozen=True)
class ForeignTable:
    """A model's signals from a foreign log, in its units, a row for each sample.

    inputs: (n, n_inputs); outputs: (n, n_outputs), NaN where not measured. time: (n,) [s] as the
    log counts it; tick: (n,) sequence numbers. torn: whether a cut last line is left out.
    """

    inputs: FloatArray
    outputs: FloatArray
    time: FloatArray
    tick: IntArray
    dt: float
    torn: bool


def check_mapping(
    model: ProcessModel, mapping: ColumnMapping, spare: Mapping[str, Collection[str]]
) -> None:
    """Raise ConfigError unless every signal of the model, and no other, has its column.

    spare: ``inputs`` and ``outputs`` that may have one as well though this model is used without
    them.
    """
    refuse([*_mistakes_of_names(model, mapping, spare), *_mistakes_of_sources(model, mapping)])


def check_columns(
    model: ProcessModel, mapping: ColumnMapping, path: Path, others: Sequence[Path]
) -> None:
    """Raise ConfigError unless a log, or one of the others beside it, has the columns."""
    _places(path, model, mapping, others)


def _mistakes_of_names(
    model: ProcessModel, mapping: ColumnMapping, spare: Mapping[str, Collection[str]]
) -> Iterator[Mistake]:
    """Of signals that the model has not, and of those that it has beside them."""
    file = mapping.file
    for group, given, signals in _groups(model, mapping.columns):
        needed, misspelt = [signal.name for signal in signals], set[str]()
        for name in given:
            if name not in needed and name not in spare[group]:
                problem, cure = f"model {model.name} has no such signal", suggestion(name, needed)
                yield file.mistake(("columns", group, name), problem, cure)
                misspelt.update(difflib.get_close_matches(name, needed, n=1))
        for name in needed:
            if name not in given and name not in misspelt:
                problem = f"{name!r} of model {model.name} is missing"
                yield file.mistake(("columns", group), problem, "add it")


def _mistakes_of_sources(model: ProcessModel, mapping: ColumnMapping) -> Iterator[Mistake]:
    """Of what signals are taken from: a constant output, a column of another one, a wrong unit."""
    file, taken = mapping.file, dict[str, Key]()
    for group, given, signals in _groups(model, mapping.columns):
        for signal in signals:
            if (column := given.get(signal.name)) is None:
                continue
            key = ("columns", group, signal.name)
            if column.constant is not None and group == "outputs":
                problem = "an output must be measured, not constant"
                yield file.mistake(key, problem, "name its 'column'")
            if column.column is not None and column.column in taken:
                before = dotted(taken[column.column])
                problem = f"{column.column!r} is the column of {before} already"
                yield file.mistake((*key, "column"), problem, "each signal has its own: name it")
            elif column.column is not None:
                taken[column.column] = key
            yield from _mistakes_of_unit(file, (*key, "unit"), column.unit, signal.unit)
    yield from _mistakes_of_unit(file, TIME_UNIT, mapping.columns.time.unit, "s")


def _mistakes_of_unit(
    file: YamlFile, key: tuple[str, ...], unit: str | None, wanted: str
) -> tuple[Mistake, ...]:
    try:
        unit_factor(file, key, unit, wanted)
    except ConfigError as error:
        return error.mistakes
    return ()


def _groups(model: ProcessModel, columns: Columns) -> list[SignalGroup]:
    return [("inputs", columns.inputs, model.inputs), ("outputs", columns.outputs, model.outputs)]


def read_foreign(
    path: Path, model: ProcessModel, mapping: ColumnMapping, others: Sequence[Path] = ()
) -> ForeignTable:
    """The model's signals of a log; others: files with columns that it lacks.

    Raises ConfigError, naming file, line and column.
    """
    places = _places(path, model, mapping, others)
    sources = {mapping.columns.inputs[signal.name].column: signal for signal in model.inputs}
    measured = {mapping.columns.outputs[name].column for name in model.output_names}
    gaps = [name for name in measured if name is not None and name not in sources]
    parts = {file: _read(file, columns, gaps, mapping) for file, columns in places.items()}
    log = parts[path]
    columns = {name: log.columns[name] for name in places[path]}
    held = {name for name, signal in sources.items() if name is not None and signal.hold == "zoh"}
    kept = np.ones(len(log.time), dtype=bool)
    for file, part in parts.items():
        if file == path:
            continue
        kept &= (log.time >= part.time[0] - 0.5 * log.dt) & (log.time <= part.time[-1] + part.dt)
        for name in places[file]:
            columns[name] = _moved(part, name, log, name in held)
    if kept.sum() < 2:
        spans = ", ".join(
            f"{file.name} {part.time[0]:g} s .. {part.time[-1]:g} s" for file, part in parts.items()
        )
        cure = "merge files whose times count from the same instant"
        raise ConfigError(f"no time is in all of {spans}", cure=cure, file=path)

    def values(group: str, given: dict[str, Column], signals: Sequence[Signal]) -> FloatArray:
        table = np.zeros((len(log.time), len(signals)))
        for j, signal in enumerate(signals):
            source, key = given[signal.name], ("columns", group, signal.name, "unit")
            factor = source.sign * unit_factor(mapping.file, key, source.unit, signal.unit)
            if source.column is not None:
                table[:, j] = columns[source.column] * factor
            elif source.constant is not None:
                table[:, j] = source.constant * factor
        return table[kept]

    inputs, outputs = (values(*group) for group in _groups(model, mapping.columns))
    return ForeignTable(inputs, outputs, log.time[kept], log.tick[kept], log.dt, log.torn)


@dataclass(frozen=True)
class _Part:
    """A file's columns, its times [s] and sequence numbers, and whether its last line was cut."""

    columns: Mapping[str, FloatArray]
    time: FloatArray
    tick: IntArray
    dt: float
    torn: bool


def _read(
    path: Path, columns: Sequence[str], gaps: Collection[str], mapping: ColumnMapping
) -> _Part:
    time = mapping.columns.time.column
    names = sorted({*columns, *([] if time is None else [time])})
    table, first_line, torn = read_table(path, names, _CURE, [n for n in gaps if n in names])
    require_rows(path, _n_rows(table))
    return _Part(table, *_foreign_time(path, table, first_line, mapping), torn)


def _n_rows(table: Mapping[str, FloatArray]) -> int:
    return len(next(iter(table.values())))


def _moved(part: _Part, name: str, log: _Part, held: bool) -> FloatArray:
    """A column of another file at the times of a log.

    A held input's is the latest before, others run straight between two samples and are NaN beside
    one that was not measured; those of a faster file pass a low-pass first.
    """
    values, time = part.columns[name], part.time
    if held:
        latest = np.searchsorted(time, log.time + 1e-3 * part.dt, side="right") - 1
        before: FloatArray = values[np.maximum(latest, 0)]
        return before
    even = len(time) == int(part.tick[-1] - part.tick[0]) + 1
    if even and log.dt > _FASTER * part.dt:
        taps = low_pass(log.dt / part.dt)
        half = len(taps) // 2
        # Beyond its ends it is taken to stay as it is.
        values = filtered(np.pad(values, half, mode="edge")[:, None], taps)[:, 0]
    return np.interp(log.time, time, values)


def _places(
    path: Path, model: ProcessModel, mapping: ColumnMapping, others: Sequence[Path]
) -> dict[Path, list[str]]:
    """The columns that are wanted of each file; ConfigError at each key that no file has."""
    time = mapping.columns.time.column
    present = {file: column_names(file) for file in (path, *others)}
    wanted: list[tuple[Key, str | None]] = []
    for group, given, signals in _groups(model, mapping.columns):
        wanted += [
            (("columns", group, s.name, "column"), given[s.name].column)
            for s in signals
            if s.name in given
        ]
    mistakes, places = [], dict[Path, list[str]]({path: []})
    if time is not None:
        mistakes = [
            mapping.file.mistake(("columns", "time", "column"), _lacking(file, time, names))
            for file, names in present.items()
            if time not in names
        ]
    for key, name in wanted:
        file = next((file for file in present if name in present[file]), None)
        if name is None or file is not None:
            if name is not None and file is not None and name not in places.get(file, ()):
                places.setdefault(file, []).append(name)
            continue
        every = [column for names in present.values() for column in names]
        mistakes.append(mapping.file.mistake(key, _lacking(path, name, every)))
    refuse(mistakes)
    return places


def _lacking(path: Path, name: str, present: Sequence[str]) -> str:
    return f"{path} has no column {name!r}; {suggestion(name, list(filter(None, present)))}"


def _foreign_time(
    path: Path, table: Mapping[str, FloatArray], first_line: int, mapping: ColumnMapping
) -> tuple[FloatArray, IntArray, float]:
    """Times [s] and sequence numbers of a foreign table's rows, and their sample time [s]."""
    time = mapping.columns.time
    if time.column is None:
        assert time.sample_rate is not None
        tick: IntArray = np.arange(_n_rows(table), dtype=np.int64)
        return tick / time.sample_rate, tick, 1.0 / time.sample_rate
    seconds = unit_factor(mapping.file, TIME_UNIT, time.unit, "s")
    values = table[time.column] * seconds
    cure = (
        "say 'grid: 0.001' (s) in 'columns: time:' to round uneven times to multiples of it, or "
        "resample the log to a constant rate"
    )
    places = None
    if time.grid is not None:
        places = np.round((values - values[0]) / time.grid)
        if np.any(np.diff(places) == 0.0) and np.all(np.diff(values) > 0.0):
            apart = f"rows of {path} are {np.diff(values).min():g} s apart; take a tenth of that"
            problem = f"{time.grid:g} s is too coarse: {apart}"
            raise mapping.file.error(("columns", "time", "grid"), problem)
        values = values[0] + places * time.grid
    tick, dt = time_base(path, values, places, first_line=first_line, column=time.column, cure=cure)
    return values, tick, dt


def unit_factor(file: YamlFile, key: tuple[str, ...], unit: str | None, wanted: str) -> float:
    """Factor from a unit in the file to the model's unit."""
    try:
        return 1.0 if unit is None else factor(unit, wanted)
    except ValueError as error:
        raise file.error(key, str(error)) from None
