"""What of a log is used, how it is prepared, and what of it is compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.identification import IdentificationConfig, RunIn, Stretch
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError, Mistake, suggestion
from daq.hal import FloatArray
from daq.logs.capture import LOG_NAME
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel
from sysid.problem.preparation import AS_IT_IS, Preparation, PreparationError, Prepared, prepare

_LONGEST_MEAN = 0.1  # of what is used of a log


@dataclass(frozen=True)
class Selection:
    """What a configuration says of its logs before they are fitted; ``KEYS`` name it.

    use: for all logs, or by the name of a capture folder or file, with or without its ending.
    merge: files beside a log with columns that it lacks, ``*`` for its name. noise: of channels,
    standard deviations in the model's units. averaged: of outputs, the time [s] before each sample
    over which it is a mean. file: where all this stands.
    """

    use: Stretch | dict[str, Stretch] | None = None
    run_in: RunIn | None = None
    robust: bool = False
    merge: tuple[str, ...] = ()
    noise: Mapping[str, float] = field(default_factory=dict)
    averaged: Mapping[str, float] = field(default_factory=dict)
    preparation: Preparation = AS_IT_IS
    file: YamlFile | None = None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Selection:
        """From a ``document``."""
        return cls.under(IdentificationConfig.model_validate(document))

    @classmethod
    def under(cls, settings: IdentificationConfig, file: YamlFile | None = None) -> Selection:
        """From settings, and the file that they stand in."""
        preparation = Preparation(
            settings.delay, settings.detrend, settings.decimate, settings.filtered
        )
        return cls(
            settings.use,
            settings.run_in,
            settings.robust,
            tuple(settings.merge),
            settings.noise,
            settings.averaged,
            preparation,
            file,
        )

    @property
    def document(self) -> dict[str, Any]:
        """The settings as they were written, those that were."""
        content = {} if self.file is None else self.file.content
        return {key: content[key] for key in KEYS if content.get(key)}

    def check_channels(self, channels: Sequence[str], outputs: Sequence[str]) -> None:
        """Raise ConfigError for a channel, or an output, that is named and that no model has."""
        named = {
            "noise": (self.noise, channels, "channel"),
            "averaged": (self.averaged, outputs, "output"),
            "filtered": (self.preparation.filtered, channels, "channel"),
            "delay": (self.preparation.delay, channels, "channel"),
            "detrend": (self.preparation.detrend, channels, "channel"),
        }
        mistakes: list[Mistake] = []
        for key, (names, possible, what) in named.items():
            for name in names:
                if name not in possible:
                    cure = suggestion(name, list(possible))
                    error = self._mistaken((key, name), f"the model has no such {what}", cure)
                    mistakes += error.mistakes
        if mistakes:
            raise ConfigError.of(mistakes)

    def merged(self, path: Path) -> list[Path]:
        """The files with more columns of a log; ConfigError for one that is not there."""
        name = path.parent.name if path.name == LOG_NAME else path.stem
        files = [path.parent / pattern.replace("*", name) for pattern in self.merge]
        for file in files:
            if not file.is_file():
                cure = "write its name as seen from the log, with * for the log's name"
                raise self._mistaken(("merge",), f"there is no {file}", cure)
        return files

    def with_noise(self, record: Dataset, model: ProcessModel) -> Dataset:
        """A record with the noise of its channels as said here."""
        if not self.noise:
            return record
        parts = (model.input_names, record.input_noise), (model.output_names, record.output_noise)
        inputs, outputs = (
            np.array([self.noise.get(name, of) for name, of in zip(names, noises, strict=True)])
            for names, noises in parts
        )
        return replace(record, input_noise=inputs, output_noise=outputs)

    def with_averages(self, record: Dataset, model: ProcessModel) -> Dataset:
        """A record with the windows of its outputs as said here; ConfigError for absurd ones."""
        if not self.averaged:
            return record
        whole = record.n_samples * record.dt
        for name, time in self.averaged.items():
            if time > _LONGEST_MEAN * whole:
                problem = f"{time:g} s is more than a tenth of {record.name}, {whole:.3g} s"
                cure = "give the time between two samples; a number without a unit is in seconds"
                raise self._mistaken(("averaged", name), problem, cure)
        shape = (*record.outputs.shape, 2)
        windows = record.windows.copy() if record.windows.size else np.zeros(shape)
        for j, name in enumerate(model.output_names):
            if name in self.averaged:
                windows[:, j] = (-self.averaged[name], 0.0)
        return replace(record, windows=windows)

    def prepared(self, record: Dataset, path: Path, model: ProcessModel) -> Prepared:
        """A record unfiltered, in time, without trend, decimated, as asked for; ConfigError."""
        try:
            return prepare(model, record, self.preparation)
        except PreparationError as error:
            problem = error.problem.replace(record.name, str(path), 1)
            raise self._mistaken(
                error.key, problem, "use more of the log, or change this"
            ) from None

    def rows(self, path: Path, time: FloatArray) -> slice:
        """The rows of a log that are used; time: of its rows, (n,) [s], as the log counts it.

        Raises ConfigError where fewer than two are left.
        """
        part, key = self._stretch(path)
        if part is None:
            return slice(None)
        first, last = part.first, part.last
        if part.rows:
            rows = slice(int(first or 1) - 1, None if last is None else int(last))
        else:
            # Times printed with few digits may stand a little before their place.
            margin = 0.01 * float(np.median(np.diff(time)))
            begin = 0 if first is None else int(np.searchsorted(time, first - margin))
            end = len(time) if last is None else int(np.searchsorted(time, last + margin))
            rows = slice(begin, end)
        count = len(range(*rows.indices(len(time))))
        if count < 2:
            problem = (
                f"{count} sample{'s' * (count != 1)} of {path} {'lie' if count != 1 else 'lies'} "
                f"in it: the log has rows 1 .. {len(time)}, {time[0]:g} s .. {time[-1]:g} s"
            )
            raise self._mistaken(key, problem, "choose a part of that")
        return rows

    def compared_from(self, dt: float) -> int:
        """Samples at the beginning of what is used that are simulated and not compared."""
        if self.run_in is None:
            return 0
        return int(self.run_in.length) if self.run_in.rows else round(self.run_in.length / dt)

    def refuse_run_in(self, path: Path, n: int) -> ConfigError:
        """A run-in beside which nothing is left of a log of so many samples."""
        problem = f"nothing is left to compare of the {n} samples of {path}"
        return self._mistaken(("run_in",), problem, "make it shorter")

    def check_names(self, paths: Sequence[Path]) -> None:
        """Raise ConfigError for a name under ``use`` that is no log's."""
        if not isinstance(self.use, dict):
            return
        names = {name: _names(path) for path in paths for name in _names(path)}
        for name in self.use:
            if name not in names:
                cure = suggestion(name, sorted({_names(path)[0] for path in paths}))
                raise self._mistaken(("use", name), "none of the logs has this name", cure)

    def _stretch(self, path: Path) -> tuple[Stretch | None, tuple[str, ...]]:
        if not isinstance(self.use, dict):
            return self.use, ("use",)
        name = next((name for name in _names(path) if name in self.use), None)
        return (None, ()) if name is None else (self.use[name], ("use", name))

    def _mistaken(self, key: tuple[str, ...], problem: str, cure: str) -> ConfigError:
        if self.file is None:
            return ConfigError.of([Mistake(problem, cure, key=".".join(key))])
        return self.file.error(key, problem, cure)


def _names(path: Path) -> Sequence[str]:
    """What a log may be called, best first."""
    if path.name == LOG_NAME:
        return [path.parent.name, str(path)]
    return [path.name, path.stem, str(path)]


KEYS = (
    "use", "merge", "noise", "averaged", "filtered", "delay", "detrend", "decimate", "run_in",
    "robust",
)  # fmt: skip

EVERYTHING = Selection()
"""All rows of every log, as they were measured."""
