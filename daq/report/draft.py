"""A report in the making: what needs no parameters is worked out while these are sought."""

from __future__ import annotations

from typing import Self

from daq.identification.baseline import Baseline, LinearData, baselines_of
from daq.identification.records import Split
from daq.report.second_process import Job, SecondProcess
from sysid import ProcessModel


class Draft:
    """Begun with the logs, before the parameters are known; ends with its context."""

    def __init__(self) -> None:
        self.second = SecondProcess()
        self._linear: Job[list[Baseline] | str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.second.__exit__()

    def begin(self, model: ProcessModel, logs: Split) -> None:
        """Have the linear baselines fitted, by another process if there is one."""
        self._linear = self.second.call(baselines_of, LinearData.of(model, *logs))

    def baselines(self, model: ProcessModel, logs: Split) -> list[Baseline] | str:
        """Those of the logs, or why there are none."""
        if self._linear is None:
            return baselines_of(LinearData.of(model, *logs))
        return self._linear.result()
