"""A report in the making: what needs no parameters is worked out while these are sought."""

from __future__ import annotations

import contextlib
from typing import Self

from daq.identification.baseline import Baseline, LinearData, baselines_of
from daq.identification.records import Split
from daq.identification.request import SettingsRequest
from daq.identification.settings import Problem, problem_of
from daq.report.second_process import Job, SecondProcess
from sysid import Dataset, ProcessModel


class Draft:
    """Begun with the logs, before the parameters are known; ends with its context."""

    def __init__(self) -> None:
        self.second = SecondProcess()
        self._linear: Job[list[Baseline] | str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.second.__exit__()

    def begin(self, problem: Problem, logs: Split) -> None:
        """Have the linear baselines fitted, by another process if there is one.

        And of a model that is new, before them, what its identification compiles after its search.
        """
        from sysid.engine.compiler import is_compiled

        if not is_compiled(problem.model):
            self.second.call(_compiled_ahead, problem.request, logs[0][0].dataset)
        self._linear = self.second.call(baselines_of, LinearData.of(problem.model, *logs))

    def baselines(self, model: ProcessModel, logs: Split) -> list[Baseline] | str:
        """Those of the logs, or why there are none."""
        if self._linear is None:
            return baselines_of(LinearData.of(model, *logs))
        return self._linear.result()


def _compiled_ahead(request: SettingsRequest, record: Dataset) -> None:
    from sysid.judging.ahead import compile_ahead

    with contextlib.suppress(Exception):  # whatever is wrong is said where it is wanted
        compile_ahead(problem_of(request).model, record)
