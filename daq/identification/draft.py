"""What a second process does of an identification and of its report, while the first goes on."""

from __future__ import annotations

import contextlib
import io
import pickle
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from daq.identification.baseline import (
    Baseline,
    LinearData,
    baselines_of,
    joined,
    of_inputs,
    of_regressors,
)
from daq.identification.records import Split
from daq.identification.settings import Problem, problem_of
from daq.second_process import Job, SecondProcess
from sysid import Dataset, ProcessModel
from sysid.threads import one_thread

if TYPE_CHECKING:
    from sysid.gassi import GASSI
    from sysid.judging.findings import Missing
    from sysid.judging.score_tests import ScoreTests
    from sysid.uncertainty import Uncertainty

    Tests = Callable[[Uncertainty], Missing]


class Draft:
    """What a second process does for one identification; report: whether there will be one."""

    def __init__(self, second: SecondProcess, report: bool = True) -> None:
        self.second, self._report = second, report
        self._data: LinearData | None = None
        self._compiled: Job[None] | None = None
        self._linear: list[Job[list[Baseline] | str]] = []

    def begin(self, problem: Problem, logs: Split) -> None:
        """Have what is wanted after the search compiled or loaded, and what a report compares."""
        request = pickle.dumps(problem.request)
        self._compiled = self.second.call(_compiled_ahead, request, logs[0][0].dataset)
        if self._report:
            self._data = LinearData.of(problem.model, *logs)
            self._linear = [self.second.call(of_inputs, self._data)]

    def baselines(self, model: ProcessModel, logs: Split) -> list[Baseline] | str:
        """Those of the logs, or why there are none."""
        if not self._linear:
            return baselines_of(LinearData.of(model, *logs))
        self._go_on()
        plain, extended = (job.result() for job in self._linear)
        return joined(plain, extended)

    def _go_on(self) -> None:
        """Have the rest of the baselines fitted, which is only wanted for the report."""
        if self._data is not None and len(self._linear) == 1:
            self._linear.append(self.second.call(of_regressors, self._data))

    def score_tests(self, problem: Problem, estimator: GASSI, training: Sequence[Dataset]) -> Tests:
        """Have tests of what the model may lack begun where a fit ended; what gives their results.

        Where the other process has something left to do, or none are wanted, they are left to this.
        """
        from sysid.judging.examination import score_tests_of

        def here(uncertainty: Uncertainty) -> Missing:
            return score_tests_of(estimator, training).missing(uncertainty)

        begun = (self._compiled, *self._linear)
        if not all(job is not None and job.is_answered for job in begun):
            return here
        fit = pickle.dumps(problem.request), _without_models((estimator, list(training)))
        tests = self.second.call(_begun, *fit)

        def missing(uncertainty: Uncertainty) -> Missing:
            if not tests.result():
                return here(uncertainty)
            job = self.second.call(_missing, *fit, uncertainty)
            self._go_on()
            return job.result()

        return missing


def _compiled_ahead(request: bytes, record: Dataset) -> None:
    from sysid.judging.ahead import compile_ahead

    with contextlib.suppress(Exception):  # whatever is wrong is said where it is wanted
        compile_ahead(_model(request), record)


@lru_cache(maxsize=1)  # its kernels are found by the model
def _model(request: bytes) -> ProcessModel:
    return problem_of(pickle.loads(request)).model


@one_thread()
def _begun(request: bytes, fit: bytes) -> bool:
    with contextlib.suppress(Exception):  # the same
        _ = _score_tests(request, fit).suspicious  # all that is asked without intervals
        return True
    return False


@one_thread()
def _missing(request: bytes, fit: bytes, uncertainty: Uncertainty) -> Missing:
    return _score_tests(request, fit).missing(uncertainty)


@lru_cache(maxsize=1)
def _score_tests(request: bytes, fit: bytes) -> ScoreTests:
    from sysid.judging.examination import score_tests_of

    estimator, training = _WithModel(fit, _model(request)).load()
    estimator.threads = 1  # the other cores are for the first process
    return score_tests_of(estimator, training)


class _WithoutModels(pickle.Pickler):
    """Writes what holds a model, which may have functions that nothing else knows."""

    def persistent_id(self, value: Any) -> str | None:
        """A word for the model, wherever it is met."""
        return "model" if isinstance(value, ProcessModel) else None


class _WithModel(pickle.Unpickler):
    """Reads that, with the model that was made anew."""

    def __init__(self, content: bytes, model: ProcessModel) -> None:
        super().__init__(io.BytesIO(content))
        self._model = model

    def persistent_load(self, _: Any) -> ProcessModel:
        """The model."""
        return self._model


def _without_models(value: Any) -> bytes:
    content = io.BytesIO()
    _WithoutModels(content).dump(value)
    return content.getvalue()
