"""Commands from a file: a CSV of one's own, or the log of another run."""

import hashlib
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from daq.errors import ConfigError
from daq.experiment import OpenLoop
from daq.hal import FloatArray
from daq.logs.table import column_names, read_table

# Names in a file of one's own, and in a log.
_COLUMNS = (("time", "motor", "brake"), ("t", "cmd_voltage_motor", "cmd_voltage_brake"))
_UNEVEN = 0.3  # of a sample that a row may stand off its place


class _Recording(NamedTuple):
    """A file's rows: time (n,) [s], commands (n, 2) [V]; first_line: of the first row."""

    path: Path
    time: FloatArray
    commands: FloatArray
    first_line: int


class Play(OpenLoop):
    """The commands in a CSV: columns time, motor, brake [s, V, V], or those of a log."""

    file: str = Field(min_length=1, description="the CSV, found from this file's folder")
    resample: Literal["hold", "linear"] | None = Field(
        None,
        description="bring rows at other times to sample_rate: hold each until the next, or join "
        "them by straight lines; without it the rows must be at sample_rate",
    )

    def waveform(self) -> FloatArray:
        """The file's commands, (n_samples, 2) [V]."""
        rows = self._read()
        if self.resample is None:
            self._check_rate(rows)
            self.samples_in(len(rows.time) / self.sample_rate, "file")
            return rows.commands
        length = rows.time[-1] - rows.time[0]
        # A row that stands on a sample but for rounding belongs to it.
        n_samples = self.samples_in(int(length * self.sample_rate + 1e-6 + 1) / self.sample_rate)
        time = rows.time[0] + np.arange(n_samples) / self.sample_rate
        if self.resample == "hold":
            late = 1e-6 / self.sample_rate
            held: FloatArray = rows.commands[np.searchsorted(rows.time, time + late, "right") - 1]
            return held
        return np.stack([np.interp(time, rows.time, c) for c in rows.commands.T], axis=1)

    def describe(self) -> dict[str, Any]:
        """The experiment as resolved, and which file was played."""
        rows = self._read()
        digest = hashlib.sha256(rows.path.read_bytes()).hexdigest()
        played = {"file": str(rows.path.resolve()), "sha256": digest, "rows": len(rows.time)}
        return {**super().describe(), "excitation": played}

    def remarks(self) -> tuple[str, ...]:
        """What is played, and whether it begins or ends with a jump."""
        rows = self._read()
        jumps = [
            f"{where} with a jump of {np.max(np.abs(row)):.3g} V"
            for where, row in (("begins", rows.commands[0]), ("ends", rows.commands[-1]))
            if row.any()
        ]
        return (", ".join([f"plays {len(rows.time)} rows of {rows.path}", *jumps]),)

    def _read(self) -> _Recording:
        """The file's rows. Raises ValueError naming file, line and column of what is wrong."""
        path = self._folder / self.file
        if not path.is_file():
            raise ValueError(
                f"file: {path}: there is no such file; the name is looked up from the folder of "
                "the experiment's file"
            )
        try:
            return self._rows(path)
        except ConfigError as error:
            raise ValueError(f"file: {error}") from None

    def _rows(self, path: Path) -> _Recording:
        present = column_names(path)
        names = next((names for names in _COLUMNS if set(names) <= set(present)), None)
        if names is None:
            wanted = " or ".join(", ".join(names) for names in _COLUMNS)
            raise ConfigError(f"{path}: its columns are {', '.join(present)}; name them {wanted}")
        cure = "a command must stand in every row; mend them"
        table, first, torn = read_table(path, names, cure)
        time, *commands = (table[name] for name in names)
        n = len(time)
        if torn:
            raise ConfigError(
                f"{path}:{first + n}: the last line has no end, so it may have been cut; complete "
                "it and end it with a new line"
            )
        if n < 2:
            raise ConfigError(f"{path}: it holds {n} row{'s' * (n != 1)}; at least 2 are needed")
        stuck = ~(np.diff(time) > 0.0)
        if stuck.any():
            raise ConfigError(
                f"{path}:{first + 1 + int(np.argmax(stuck))}: {names[0]}: time does not advance "
                "from the line before"
            )
        return _Recording(path, time, np.stack(commands, axis=1), first)

    def _check_rate(self, rows: _Recording) -> None:
        """Raises ValueError, naming file and line, unless the rows are at the sample rate."""
        cure = "or say how to bring them to it with resample: hold or resample: linear"
        steps = np.diff(rows.time)
        usual = float(np.median(steps))
        uneven = np.abs(steps / usual - 1.0) > _UNEVEN
        if uneven.any():
            row = int(np.argmax(uneven))
            raise ValueError(
                f"file: {rows.path}:{row + 1 + rows.first_line}: {steps[row]:g} s after the row "
                f"before, but rows are {usual:g} s apart elsewhere; fill the gap, {cure}"
            )
        n = len(rows.time) - 1
        length = float(rows.time[-1] - rows.time[0])
        # Times printed with few digits are each a little off; their ends together are not.
        if abs(length * self.sample_rate - n) > 0.5:
            raise ValueError(
                f"file: {rows.path}: its rows are at {n / length:.6g} Hz, not at the sample_rate "
                f"of {self.sample_rate:g} Hz; change sample_rate, {cure}"
            )
