"""What would run an experiment: which records it would give, and whether it kept its limits."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.engine.stepper import Stepper
from sysid.experiments.feedback import Feedback
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel


class Bench(Protocol):
    """A rig, or what stands for it before anything is energised."""

    def records(
        self, inputs: FloatArray | Feedback, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """What a run would log if the parameters were each of ``vectors`` (n, n_parameters).

        inputs: (n_samples, n), as an excitation gives them, or what makes them while it runs;
        dt: sample time [s]. None where a run with any of the vectors would pass a limit. Of a
        record inputs, first samples and jitter count. Several threads ask at once.
        """


class FreeRun:
    """A model that runs by itself, with limits of its inputs, states and outputs.

    limits: (low, high) by the signal's name. margin: part of the distance from zero to a limit that
    is kept from it.

    >>> from sysid.examples import lag
    >>> bench = FreeRun(BatchSimulator(lag()), {"y": (-3.0, 3.0)})
    >>> vectors = np.array([[2.0, 0.05], [4.0, 0.05]])
    >>> bench.records(np.ones((50, 1)), 0.01, vectors[:1])[0].n_samples
    50
    >>> bench.records(np.ones((50, 1)), 0.01, vectors) is None  # the second would reach 4
    True
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        limits: Mapping[str, tuple[float, float]] | None = None,
        margin: float = 0.1,
    ) -> None:
        self._model, self._limits, self._margin = simulator.model, dict(limits or {}), margin
        self._simulator = simulator
        inputs, outputs = self._model.input_names, self._model.output_names
        beyond = [name for name in self._limits if name not in (*inputs, *outputs)]
        if beyond:
            watched = self._model.with_outputs((*outputs, *beyond))
            self._simulator = BatchSimulator(watched, accuracy=simulator.accuracy)
        for name, (low, high) in self._limits.items():
            if not low < high:
                raise ModelError(f"limits of {name}: low end {low:g} is not below {high:g}")

    def records(
        self, inputs: FloatArray | Feedback, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """As of ``Bench``: every vector gives the same record, but of a feedback."""
        if isinstance(inputs, Feedback):
            return self._closed_loops(inputs, dt, vectors)
        names = self._model.input_names
        if not all(self._within(inputs[:, j], name) for j, name in enumerate(names)):
            return None
        record = _without_outputs(self._model, inputs, dt)
        if self._limits.keys() - set(names):
            watched = self._simulator.model
            blank = _without_outputs(watched, inputs, dt)
            outputs = self._simulator.trajectories(vectors, blank)
            signals = enumerate(watched.output_names)
            if not all(self._within(outputs[..., j], name) for j, name in signals):
                return None
        return [record] * len(vectors)

    def _closed_loops(
        self, feedback: Feedback, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        records: list[Dataset] = []
        for vector in vectors:
            inputs, _ = feedback.run(Stepper(self._model, vector, dt))
            of_it = self.records(inputs, dt, vector[None])
            if of_it is None:
                return None
            records += of_it
        return records

    def _within(self, values: FloatArray, name: str) -> bool:
        low, high = (
            (1.0 - self._margin) * end for end in self._limits.get(name, (-np.inf, np.inf))
        )
        return bool(np.all((values >= low) & (values <= high)))


def _without_outputs(model: ProcessModel, inputs: FloatArray, dt: float) -> Dataset:
    return Dataset(inputs, np.full((len(inputs), len(model.outputs)), np.nan), dt, "design")
