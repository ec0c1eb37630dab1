"""Which samples of a log are used, which of them are compared, and which count as not measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.identification import IdentificationConfig, RunIn, Stretch
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError, Mistake, suggestion
from daq.hal import FloatArray
from daq.logs.capture import LOG_NAME


@dataclass(frozen=True)
class Selection:
    """What ``use``, ``run_in`` and ``robust`` of a configuration say of its logs.

    use: for all logs, or by the name of a capture folder or file, with or without its ending.
    file: where they stand.
    """

    use: Stretch | dict[str, Stretch] | None = None
    run_in: RunIn | None = None
    robust: bool = False
    file: YamlFile | None = None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Selection:
        """From a ``document``."""
        settings = IdentificationConfig.model_validate(document)
        return cls(settings.use, settings.run_in, settings.robust)

    @property
    def document(self) -> dict[str, Any]:
        """The settings as they were written, those that were."""
        content = {} if self.file is None else self.file.content
        keys = ("use", "run_in", "robust")
        return {key: content[key] for key in keys if content.get(key) is not None}

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


EVERYTHING = Selection()
"""All rows of every log, as they were measured."""
