"""From log files to the records a process model is fitted to."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from daq.config.identification import Column, Columns, TimeColumn
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError, Mistake, suggestion
from daq.hal import FloatArray, IntArray
from daq.identification.foreign import TIME_UNIT, ColumnMapping, read_foreign
from daq.identification.selection import EVERYTHING, Selection
from daq.logs import matlab
from daq.logs.capture import LOG_NAME, RUN_NAME, read_record, settings_of
from daq.logs.columns import COLUMNS, ORIGINAL_COLUMNS
from daq.logs.encoder import SPEED, MeanSpeeds
from daq.logs.recording import Recording, end_of_run, log_path
from daq.logs.recording import load as load_recording
from daq.logs.table import column_names
from daq.logs.time_base import refuse_rows, require_rows, time_base
from daq.lookup.models import DEFAULT_MODEL, find_model, name_parts
from daq.views import Shown
from sysid.problem.data import Dataset
from sysid.problem.faults import mended
from sysid.problem.model import ModelError, ProcessModel

if TYPE_CHECKING:
    import pandas as pd

_LARGEST = 1e100  # of a sample: far beyond, squares are infinite


@dataclass(frozen=True)
class Preparation:
    """What was done to a log before it was used: its steps, and the record before and after them.

    used: what ``use`` leaves of the record, otherwise as it was logged. start: where in the record
    before the steps the one after them begins [s].
    """

    steps: tuple[str, ...]
    before: Dataset
    used: Dataset
    after: Dataset
    start: float


@dataclass(frozen=True)
class Cut:
    """The whole of a log of which a part is used, and which, in words."""

    whole: Dataset
    step: str


@dataclass(frozen=True, repr=False)
class LoggedRecord(Shown):
    """A log as a record for a model; warning: how a run that did not complete ended.

    measured: its record with the faulty samples that ``robust`` leaves out of ``dataset``, and of
    a part of a prepared log as it was; None for what shows them itself. preparation: what was done
    to it before, None for nothing. merged: files with columns of it. of_a_rig: whether it is a
    run's log, with all that a run logs.
    """

    dataset: Dataset
    path: Path
    warning: str | None
    measured: Dataset | None = None
    preparation: Preparation | None = None
    merged: tuple[Path, ...] = ()
    of_a_rig: bool = False

    @property
    def headline(self) -> str:
        """Its name, length and rate."""
        n, dt = self.dataset.n_samples, self.dataset.dt
        return f"{self.dataset.name}, {n} samples, {n * dt:.4g} s at {1.0 / dt:.4g} Hz"

    @property
    def unmended(self) -> Dataset:
        """Its record in which faults of samples show: a low-pass makes overshoots of levels."""
        if self.measured is not None:
            return self.measured
        made = self.preparation
        return self.dataset if made is None or made.after is made.used else made.used


Split = tuple[list[LoggedRecord], list[LoggedRecord]]  # for training, for validation


def expand(path: Path) -> list[Path]:
    """Logs named on the command line: a folder that is no capture stands for what is in it.

    That is the CSV and MAT files, or else the capture folders, but for those of runs that failed
    before their second sample.
    """
    if not path.is_dir() or (path / LOG_NAME).exists():
        return [path]
    if logs := sorted((*path.glob("*.csv"), *path.glob(f"*{matlab.SUFFIX}"))):
        return logs
    if captures := sorted(log.parent for log in path.glob(f"*/{LOG_NAME}")):
        return [capture for capture in captures if _begun(capture / LOG_NAME)] or captures
    problem = "neither a capture folder (with log.csv) nor a folder of CSV files or captures"
    raise ConfigError(problem, cure="name logs, or a folder that holds them", file=path)


def intended_model(paths: Iterable[Path]) -> str | None:
    """Installed model that the experiments of runs are for; None where they name none.

    Logs of other programs say nothing. Raises ConfigError where runs are for different models, and
    for a Python file, which a run's record is not to choose.
    """
    runs: dict[str, Path] = {}
    for log in (log for path in paths for log in expand(path)):
        if (named := _named_model(log)) is not None:
            runs.setdefault(named, log_path(log).parent)
    if len(runs) > 1:
        each = ", ".join(f"{name} ({run})" for name, run in runs.items())
        cure = "name one with --model, or identify them apart, as rig campaign does"
        raise ConfigError(
            f"the experiments of these runs are for different models: {each}", cure=cure
        )
    for name, run in runs.items():
        place = Mistake("", file=run / RUN_NAME, key="model")
        if name_parts(name)[1] is not None:
            cure = "look at that file, then name it with --model"
            problem = f"the experiment is for {name}, which would be run as a program"
            raise ConfigError.of([replace(place, problem=problem, cure=cure)])
        try:
            find_model(name)
        except ConfigError as error:
            raise ConfigError.of(mistake.behind(place) for mistake in error.mistakes) from None
    return next(iter(runs), None)


def by_intended_model(paths: Iterable[Path]) -> list[list[Path]]:
    """Logs in lists, of which each is for one model as far as runs name one."""
    logs: dict[str | None, list[Path]] = {}
    for log in (log for path in paths for log in expand(path)):
        logs.setdefault(_named_model(log), []).append(log)
    return list(logs.values())


def _named_model(log: Path) -> str | None:
    """The model that a run's experiment is for; None for a log of another program."""
    experiment, _ = settings_of(read_record(log_path(log)) or {})
    return str(experiment.get("model") or DEFAULT_MODEL) if experiment else None


def _begun(log: Path) -> bool:
    """Whether rows follow the names of its columns, two at least."""
    with log.open("rb") as lines:
        return len(list(islice(lines, 3))) == 3


def load(
    path: Path,
    model: ProcessModel,
    mapping: ColumnMapping | None,
    selection: Selection = EVERYTHING,
) -> LoggedRecord:
    """One log as a record; ConfigError names the file, line and column of what is wrong.

    mapping: of columns to signals; None for a rig's log, or a table of the signals by their names.
    """
    csv = log_path(path)
    try:
        mapping = mapping or _by_name(csv, model)
        if mapping is not None:
            return _foreign(csv, model, mapping, selection)
        return from_recording(load_recording(path), model, selection)
    except ModelError as error:
        raise ConfigError(str(error), file=path) from None


def _by_name(csv: Path, model: ProcessModel) -> ColumnMapping | None:
    """Of a table that has time ``t`` [s] and the model's signals by name; None for a rig's log.

    Raises ConfigError for another program's without all of them.
    """
    present = column_names(csv) if csv.is_file() else ()
    names = (*model.input_names, *model.output_names)
    lacking = [name for name in ("t", *names) if name not in present]
    of_a_rig = set(ORIGINAL_COLUMNS) <= set(present)
    if not present or of_a_rig or (lacking and not set(names).isdisjoint(COLUMNS)):
        return None
    if lacking:
        cure = (
            f"it has {', '.join(present)}. Call columns t (in seconds) and as the model does, or "
            "say which is which in the 'columns' section of a file given with --config"
        )
        problem = f"model {model.name} needs {', '.join(lacking)}, of which there is no column"
        raise ConfigError(problem, cure=cure, file=csv, line=1)
    inputs, outputs = (
        {name: Column(column=name) for name in part}
        for part in (model.input_names, model.output_names)
    )
    columns = Columns(time=TimeColumn(column="t"), inputs=inputs, outputs=outputs)
    return ColumnMapping(YamlFile(csv, {}, {}), columns)


def from_recording(
    recording: Recording, model: ProcessModel, selection: Selection = EVERYTHING
) -> LoggedRecord:
    """A log that has been read as a record; ConfigError, ModelError."""
    speeds = recording.mean_speeds() if SPEED in model.output_names else None
    dataset = _from_log(recording, model, recording.name, selection, speeds)
    # What the offset calibration measured: standard deviations of noise and of zeros.
    noise, zero = np.array([recording.noise(n) for n in model.input_names]).reshape(-1, 2).T
    outputs = np.array([recording.noise(n) for n in model.output_names]).reshape(-1, 2).T
    calibrated = {"output_noise": outputs[0], "output_zero": outputs[1]}
    planned = recording.planned
    dataset = replace(dataset, input_noise=noise, input_zero=zero, planned=planned, **calibrated)
    time = recording.columns["t"]
    whole = partial(_from_log, recording, model, recording.name, EVERYTHING, speeds)
    cut = _cut(selection, recording.path, time, whole)
    log = LoggedRecord(dataset, recording.path, recording.warning, of_a_rig=True)
    return _prepared(log, model, selection, cut)


def from_frame(
    frame: pd.DataFrame, name: str, model: ProcessModel, selection: Selection = EVERYTHING
) -> LoggedRecord:
    """A table with time ``t`` [s] and the model's signals by name; ConfigError, ModelError."""
    path, wanted = Path(name), ("t", *model.input_names, *model.output_names)
    for column in wanted:
        if column not in frame:
            cure = f"the table has {', '.join(map(str, frame.columns))}. Rename or add it"
            problem = f"model {model.name} needs the column {column!r}"
            raise ConfigError(problem, cure=cure, file=name)
        if frame[column].dtype.kind == "c":
            cure = "give real numbers, such as its .real"
            raise ConfigError("its numbers are complex", cure=cure, file=name, key=column)
    require_rows(path, len(frame))
    try:
        numbers = frame.loc[:, list(wanted)].astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"a column is not of numbers: {error}", file=name) from None
    columns: dict[str, npt.NDArray[Any]] = {name: numbers[name].to_numpy() for name in wanted}
    for column, values in columns.items():
        is_output = column in model.output_names
        wrong = np.isinf(values) if is_output else ~np.isfinite(values)
        cure = "NaN stands for what was not measured" if is_output else "remove these rows"
        refuse_rows(path, wrong, "it is not finite", 0, column, cure)
    columns["tick"], dt = time_base(path, columns["t"], first_line=0)
    log = Recording(path, columns, dt)
    cut = _cut(selection, path, columns["t"], partial(_from_log, log, model, name, EVERYTHING))
    record = LoggedRecord(_from_log(log, model, name, selection), path, None)
    return _prepared(record, model, selection, cut)


def _prepared(
    log: LoggedRecord, model: ProcessModel, selection: Selection, cut: Cut | None
) -> LoggedRecord:
    """A log as ``delay``, ``detrend``, ``decimate``, ``run_in`` and ``robust`` want it.

    cut: where not all of it is used.
    """
    dataset = selection.with_averages(selection.with_noise(log.dataset, model), model)
    log = replace(log, dataset=dataset)
    steps = (*_merging(log), *([] if cut is None else [cut.step]))
    used, start = log.dataset, 0.0
    if selection.preparation.needed:
        made = selection.prepared(used, log.path, model)
        steps, start = steps + made.steps, made.start
        log = replace(log, dataset=replace(made.dataset, begin=used.begin + start))
    if steps:
        before = used if cut is None else cut.whole
        start += used.begin - before.begin
        log = replace(log, preparation=Preparation(steps, before, used, log.dataset, start))
    log = replace(log, dataset=_without_run_in(log.dataset, log.path, model, selection))
    return _mended(log, model, selection)


def _merging(log: LoggedRecord) -> tuple[str, ...]:
    return (f"merged with {', '.join(map(str, log.merged))}",) if log.merged else ()


def _cut(
    selection: Selection, path: Path, time: FloatArray, whole: Callable[[], Dataset]
) -> Cut | None:
    """Where ``use`` leaves rows of a log out; time: (n,) [s], of all; whole: gives their record."""
    first, last, _ = selection.rows(path, time).indices(len(time))
    if (first, last) == (0, len(time)):
        return None
    part = f"{time[first]:g} s .. {time[last - 1]:g} s"
    return Cut(whole(), f"cut to {part}, rows {first + 1} .. {last} of {len(time)}")


def _mended(log: LoggedRecord, model: ProcessModel, selection: Selection) -> LoggedRecord:
    """A log without its faulty samples, where ``robust`` wants that."""
    if not selection.robust:
        return log
    return replace(log, dataset=mended(model, log.dataset), measured=log.dataset)


def _foreign(
    path: Path, model: ProcessModel, mapping: ColumnMapping, selection: Selection
) -> LoggedRecord:
    """A log of another program as a record."""
    others = selection.merged(path)
    table = read_foreign(path, model, mapping, others)
    rows = selection.rows(path, table.time)
    inputs, outputs, tick = table.inputs[rows], table.outputs[rows], table.tick[rows]
    time = table.time[rows]
    if selection.run_in is None:
        # The first sample tells where the model starts.
        first = int(np.argmax(np.isfinite(outputs).all(axis=1)))
        inputs, outputs, tick = inputs[first:], outputs[first:], tick[first:]
        time = time[first:]
    if _is_sparse(tick):
        problem = (
            f"read in {mapping.columns.time.unit}, times of {path} cover {tick[-1] - tick[0] + 1} "
            f"sample times of {table.dt:g} s, of which it holds {len(tick)}"
        )
        cure = "write the unit that they are in: s, ms, us, min, h"
        raise mapping.file.error(TIME_UNIT, f"{problem}, too few to identify from", cure)
    dataset = replace(
        _dataset(path, model, inputs, outputs, tick, table.dt, path.stem),
        begin=float(time[0]),
    )
    warning = end_of_run(path, read_record(path), table.torn)

    def whole() -> Dataset:
        if _is_sparse(table.tick):  # what is left out may have any gaps
            return dataset
        parts = table.inputs, table.outputs, table.tick
        record = _dataset(path, model, *parts, table.dt, path.stem)
        return replace(record, begin=float(table.time[0]))

    cut = _cut(selection, path, table.time, whole)
    log = LoggedRecord(dataset, path, warning, merged=tuple(others))
    return _prepared(log, model, selection, cut)


def hold_back(logs: list[LoggedRecord], part: float) -> Split:
    """The beginnings of logs, to train on, and the last ``part`` of each, to validate by.

    An end starts where every output was measured, so that its first sample tells where it
    starts. Raises ConfigError when a beginning or an end holds too little.
    """
    if part == 0.0:
        return logs, []
    halves = [_halves(log, part) for log in logs]
    return [begin for begin, _ in halves], [end for _, end in halves]


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
                f"with hold_back {part:g} the {share} of it hold {last - first} samples"
                f"{'' if measured.all() else ' and miss an output'}",
                cure="hold back another part, or validate with another log",
                file=log.path,
            )
        name = f"{whole.name} ({share})"
        half = replace(log, dataset=whole.part(first, last, name))
        if log.unmended is not whole:
            scale = whole.dt / log.unmended.dt  # of a decimated log
            unmended = log.unmended.part(round(first * scale), round(last * scale), name)
            half = replace(half, measured=unmended)
        halves.append(half)
    return halves[0], halves[1]


def _from_log(
    log: Recording,
    model: ProcessModel,
    title: str,
    selection: Selection,
    speeds: MeanSpeeds | None = None,
) -> Dataset:
    """The model's signals of a log; speeds: what its encoder's are the means of."""
    columns = log.columns
    for name in (*model.input_names, *model.output_names):
        if name not in columns:
            problem = f"model {model.name} needs {name!r}, which is no column of this log"
            section = "Name the column in the 'columns' section of a file given with --config"
            cure = f"{suggestion(name, list(columns))} {section}"
            raise ConfigError(problem, cure=cure, file=log.path)
        _refuse_absurd(log.path, columns["t"], name, columns[name])
    inputs, outputs = (
        np.reshape([columns[name] for name in names], (len(names), -1)).T.astype(np.float64)
        for names in (model.input_names, model.output_names)
    )
    tick, rows = columns["tick"], selection.rows(log.path, columns["t"])
    if speeds is not None:
        speed = np.array([name == SPEED for name in model.output_names])
        outputs = np.where(speed, speeds.values[:, None], outputs)
    dataset = _dataset(log.path, model, inputs[rows], outputs[rows], tick[rows], log.dt, title)
    dataset = replace(dataset, begin=float(columns["t"][rows][0]))
    if speeds is not None:
        shape = dataset.outputs.shape
        windows, jitter, colour = np.zeros((*shape, 2)), np.zeros(shape), np.zeros(shape)
        places = tick[rows] - tick[rows][0]
        windows[places] = np.where(speed[:, None], speeds.windows[rows][:, None], 0.0)
        jitter[places] = np.where(speed, speeds.jitter[rows][:, None], 0.0)
        colour[places] = np.where(speed, speeds.colour[rows][:, None], 0.0)
        dataset = replace(dataset, windows=windows, jitter=jitter, jitter_colour=colour)
    return dataset


def _refuse_absurd(path: Path, time: FloatArray, name: str, values: FloatArray) -> None:
    """Raise ConfigError at the first sample whose square is no number, if any."""
    absurd = np.abs(values) > _LARGEST
    if absurd.any():
        at = int(np.argmax(absurd))
        problem = f"at t = {time[at]:g} s it is {values[at]:.3g}, which nothing measures"
        cure = "mend it, or cut it out, as by 'use: 0 s .. 1 s'"
        raise ConfigError(problem, cure=cure, file=path, key=name)


def _without_run_in(
    dataset: Dataset, path: Path, model: ProcessModel, selection: Selection
) -> Dataset:
    """A record whose run-in is not compared: only its first sample tells where states start."""
    begin = selection.compared_from(dataset.dt)
    if begin == 0:
        return dataset
    if begin > dataset.n_samples - 2:
        raise selection.refuse_run_in(path, dataset.n_samples)
    outputs = dataset.outputs.copy()
    outputs[1:begin] = np.nan
    no_starts = [name not in model.state_names for name in model.output_names]
    outputs[0, no_starts] = np.nan
    return replace(dataset, outputs=outputs)


def _is_sparse(tick: IntArray) -> bool:
    """Whether hardly any of the sample times that a log covers have a sample."""
    return int(tick[-1] - tick[0]) + 1 > 50 * len(tick) + 1000


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
    if _is_sparse(tick):
        problem = f"the log covers {length} sample times but holds {len(rows)} samples"
        cure = "too much is missing to identify anything from it"
        raise ConfigError(problem, cure=cure, file=path)
    whole = np.full((length, len(model.outputs)), np.nan)
    whole[rows] = outputs
    latest = np.zeros(length, dtype=np.int64)
    latest[rows] = np.arange(len(rows))
    filled = inputs[np.maximum.accumulate(latest)]
    for column, signal in enumerate(model.inputs):
        if signal.hold != "zoh":
            filled[:, column] = np.interp(np.arange(length), rows, inputs[:, column])
    return Dataset(filled, whole, dt, name)
