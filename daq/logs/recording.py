"""Logs as they are read back, however their runs ended."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from daq.config.rig import Encoder
from daq.errors import ConfigError
from daq.hal import Samples
from daq.logs.capture import (
    COMPLETED,
    LOG_NAME,
    RUN_NAME,
    RUNNING,
    further_parts,
    is_log,
    read_record,
    settings_of,
)
from daq.logs.columns import ATTRIBUTES, COLUMNS, ORIGINAL_COLUMNS, UNITS
from daq.logs.encoder import SPEED, MeanSpeeds, mean_speeds
from daq.logs.table import column_names, read_table
from daq.logs.time_base import refuse_rows, require_rows, time_base
from daq.views import Lines, Shown

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, repr=False)
class Recording(Shown):
    """A log in SI units, with what is known of its run.

    columns: (n_samples,) each, at least those of the original program and ``tick``,
    ``applied_voltage_motor``, ``applied_voltage_brake``, ``flags``. dt: sample time [s]. torn: the
    last line was cut, or broken by a measurement that is no number, and left out. record: what
    run.json holds, None without one. warning: None for a run that completed, else one line that
    says how it ended.

    >>> columns = {"t": np.array([0.0, 0.1])}
    >>> Recording(Path("runs/20260101T120000Z-prbs/log.csv"), columns, dt=0.1).name
    '20260101T120000Z-prbs'
    """

    path: Path
    columns: Mapping[str, npt.NDArray[Any]]
    dt: float
    torn: bool = False
    record: dict[str, Any] | None = None
    warning: str | None = None

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The columns as a table, one row per sample."""
        import pandas as pd  # a fifth of a second, of most commands for nothing

        return pd.DataFrame(dict(self.columns))

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return len(self.columns["t"])

    @property
    def name(self) -> str:
        """Folder name of a capture, or file name of a lone log."""
        return self.path.parent.name if self.path.name == LOG_NAME else self.path.stem

    @property
    def headline(self) -> str:
        """Its name, length and rate, and how the run ended if not as it should."""
        n = self.n_samples
        size = f"{self.name}, {n} samples, {n * self.dt:.4g} s at {1.0 / self.dt:.4g} Hz"
        return size if self.warning is None else f"{size}; {self.warning}"

    def lines(self) -> Lines:
        """Smallest, mean and largest of each channel."""
        rows = [["channel", "unit", "smallest", "mean", "largest"]]
        for name, unit in UNITS.items():
            if name in self.columns and name != "t":
                column = self.columns[name]
                figures = column.min(), column.mean(), column.max()
                rows.append([name, unit, *(f"{figure:.4g}" for figure in figures)])
        return rows

    @property
    def folder(self) -> Path:
        """Where the log stands."""
        return self.path.parent

    def samples(self) -> Samples:
        """Its rows as the run had them."""
        return Samples(**{attribute: self.columns[name] for name, attribute in ATTRIBUTES.items()})

    @property
    def planned(self) -> bool:
        """Whether all commands are known to have been planned, so that none answers a sample."""
        return self.record is not None and self.record.get("planned") is True

    def noise(self, channel: str) -> tuple[float, float]:
        """Standard deviations of a channel's noise and of its zero, as the calibration found them.

        Zeros for a channel that was not calibrated, and without a run record. Raises ConfigError
        for a record that has been tampered with.
        """
        calibration = (self.record or {}).get("calibration", {})
        try:
            deviation = float(calibration.get("noise", {}).get(channel, 0.0))
            samples = int(calibration.get("samples", 1))
            if not (math.isfinite(deviation) and deviation >= 0.0 and samples > 0):
                raise ValueError
        except (AttributeError, OverflowError, TypeError, ValueError):
            raise ConfigError(
                f"'calibration' must hold 'samples' and, for {channel}, a 'noise' of 0 or more",
                cure="delete it to go without",
                file=self.folder / RUN_NAME,
            ) from None
        return deviation, deviation / math.sqrt(samples)

    def mean_speeds(self) -> MeanSpeeds | None:
        """What the speeds are means of that an encoder's edges made; None of all others."""
        if self.record is None:
            return None
        try:
            sensors = settings_of(self.record)[1]["sensors"]
            encoder = Encoder.model_validate(sensors["encoder"])
        except (KeyError, TypeError, ValueError):
            return None
        tick, theta, omega = (self.columns[name] for name in ("tick", "theta", SPEED))
        by_edges = encoder.speed == "edges"
        return mean_speeds(tick, theta, omega, self.dt, encoder.count, by_edges)


def load(path: str | Path, extra: Sequence[str] = ()) -> Recording:
    """Read a capture folder, its log.csv, or a lone CSV in either program's format.

    extra: names of further columns wanted, where it has them. Raises ConfigError naming the file,
    line and column of what is wrong with the log.

    >>> import tempfile
    >>> csv = Path(tempfile.mkdtemp()) / "day1.csv"
    >>> rows = ",".join(ORIGINAL_COLUMNS), "0,1,0,0,0,0,0,0", "0.1,1,0,0.5,0,0,0,0", ""
    >>> _ = csv.write_text("\\n".join(rows))
    >>> recording = load(csv)
    >>> recording.name, recording.dt, recording.frame["current_motor"].tolist()
    ('day1', 0.1, [0.0, 0.5])
    """
    csv = log_path(Path(path))
    if not csv.exists() and (parts := further_parts(csv)):
        cure = f"what was recorded afterwards is in {', '.join(parts)}: name that file"
        raise ConfigError("the log was deleted while it was written", cure=cure, file=csv)
    present = column_names(csv)
    names = [name for name in COLUMNS if name in present or name in ORIGINAL_COLUMNS]
    names += [name for name in extra if name in present]
    table, first_line, torn = read_table(csv, names)
    columns: dict[str, npt.NDArray[Any]] = {**table}
    require_rows(csv, len(columns["t"]))
    columns["tick"], dt = time_base(csv, columns["t"], columns.get("tick"), first_line=first_line)
    for channel in ("motor", "brake"):
        # The original program logged only what it asked for.
        columns.setdefault(f"applied_voltage_{channel}", columns[f"cmd_voltage_{channel}"])
    flags = columns.setdefault("flags", np.zeros(len(columns["t"])))
    refuse_rows(csv, flags % 1.0 != 0.0, "it must be a whole number", first_line, "flags")
    columns["flags"] = flags.astype(np.int64)
    record = read_record(csv)
    return Recording(csv, columns, dt, torn, record, end_of_run(csv, record, torn))


def load_whole(path: str | Path) -> Recording:
    """A log as ``load`` reads it, with every column that it has; ConfigError for a foreign one."""
    csv = log_path(Path(path))
    present = column_names(csv) if csv.exists() else ()
    missing = [name for name in ORIGINAL_COLUMNS if name not in present]
    if present and missing:
        problem = f"it is no log of 'rig run', without {', '.join(missing)}: it has "
        problem += ", ".join(present)
        cure = "name a capture folder; logs of other programs are for rig identify and rig replay"
        raise ConfigError(problem, cure=cure, file=csv)
    return load(path, [name for name in present if name not in COLUMNS])


def log_path(path: Path) -> Path:
    """The CSV that a folder or file name given by a user means."""
    return path / LOG_NAME if path.is_dir() else path


def end_of_run(csv: Path, record: dict[str, Any] | None, torn: bool) -> str | None:
    """One line on how a run ended that did not complete, or None."""
    record = record or {}
    cut = "; its last line is incomplete and is left out" if torn else ""
    if parts := further_parts(csv):
        cut += f"; it was disturbed, and went on in {', '.join(parts)}, which is not read with it"
    elif csv.name != LOG_NAME and is_log(csv):
        cut += f"; this part of it begins where {LOG_NAME} was disturbed"
    status = record.get("status", COMPLETED)
    if status == RUNNING:
        return f"{csv}: the run was interrupted (killed, or still running){cut}"
    if status != COMPLETED:
        return f"{csv}: the run ended early: {status}: {record.get('reason')}{cut}"
    return f"{csv}: the log was interrupted{cut}" if cut else None
