"""How a filter's innovations move when something is added to a model's equations.

As of a free run (``disturbed``), along the filter's own estimate: where noise of the inputs leads
a free run far from where the plant was, functions of its states are none of the plant's, and what
they would do is bent. A filter knows where the plant is, and its innovations are white.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.linear_response import LinearResponse, observed, slope_of
from sysid.engine.windows import average
from sysid.fitting.innovations import Innovations
from sysid.judging.disturbed import DisturbedRun, shifted
from sysid.judging.input_noise import likely_noise
from sysid.threads import Workers

_SMALL = 1e-6  # part of the parameters by which slopes of the outputs over them are told


@dataclass(eq=False, kw_only=True)
class FilteredRun(DisturbedRun):
    """A filter's run of a record under parameters (n_parameters,), and what disturbances change.

    As a free run, with changes of the innovations, in the outputs' units, for those of the outputs.
    scale: (n_outputs,), of the innovations in the response. states: (n_samples, n_states), what the
    filter foresees at each sample from those before, so that no function of it is of what was
    measured then; outputs: that over the record's windows.
    """

    scale: FloatArray

    @classmethod
    def of(
        cls,
        objective: Innovations,
        chromosome: FloatArray,
        place: int,
        response: LinearResponse,
        workers: Workers,
    ) -> Self:
        """The run of the record at a place; response: of its filter."""
        model, record = objective.simulator.model, objective.records[place]
        return cls(
            model,
            objective.space.full(chromosome[None])[0],
            record,
            record.inputs,
            record.initial_state(model),
            response,
            objective.colour[place],
            workers,
            scale=objective.scales[place],
        )

    def over(self, windows: FloatArray) -> FloatArray:
        """Outputs of these states over other windows, (n_samples, n_outputs, 2)."""
        outputs = self.instants.copy()
        for j in np.flatnonzero(windows.any(axis=(0, 2))).tolist() if windows.size else ():
            outputs[:, j] = means(outputs[:, j], windows[:, j] / self.record.dt)
        return outputs

    @cached_property
    def instants(self) -> FloatArray:
        """Outputs of these states at their instants, (n_samples, n_outputs)."""
        return self._observed(np.zeros_like(self.vector))

    def averaged(self, j: int, signal: FloatArray) -> FloatArray:
        """A change (n_samples,) of output j at its instants as its sensor averages it."""
        windows = self._windows(j)
        return means(signal, windows / self.record.dt) if windows.any() else signal

    def mean(self, j: int) -> FloatArray:
        """None: a filter's foresight is not that of a free run."""
        return np.zeros(len(self.outputs))

    def late(self, j: int, delay: float) -> FloatArray:
        """Change (n_samples,) of output j by so many seconds that it comes late.

        That it comes early is as much less: what is foreseen later holds noise of what is measured.
        """
        if delay < 0.0:
            return -self.late(j, -delay)
        if self._windows(j).any():
            return (self.over(self.record.windows - delay) - self.outputs)[:, j]
        return shifted(self.outputs[:, j], -delay / self.record.dt, True)

    def _windows(self, j: int) -> FloatArray:
        """Windows of output j, (n_samples, 2); none where all are sampled at their instants."""
        return self.record.windows[:, j] if self.record.windows.size else np.zeros(0)

    def likely_noise(self, i: int) -> FloatArray:
        """What of input i is likely to be noise, (n_samples,)."""
        deviation = float(self.record.input_noise[i])
        return likely_noise(self.measured[:, i], deviation, float(self.colour[i]))

    def logged(self, outputs: FloatArray) -> FloatArray:
        """Change by what is logged of the outputs beside what was foreseen, (n_samples, ...)."""
        return self._change(self.response.of(outputs=outputs))

    def moved(self, vector: FloatArray, start: FloatArray) -> FloatArray:
        """Change by a change of the parameters (n_parameters,), and of the states' start."""
        outputs = None
        if self.model.output is not None:
            outputs = self._by_observation(vector)
        return self._change(self.response.of(vector=vector, start=start, outputs=outputs))

    def _by_observation(self, vector: FloatArray) -> FloatArray:
        """Change of the outputs by that of the parameters in the output function itself."""
        size = np.max(np.abs(vector) / np.maximum(np.abs(self.vector), 1e-300), initial=0.0)
        if not size:
            return np.zeros(self.record.outputs.shape)
        return slope_of(lambda part: self._observed(part * vector), _SMALL / size)

    def _observed(self, vector: FloatArray) -> FloatArray:
        """Outputs of the states at their instants with something added to the parameters."""
        return observed(self.model, self.states, self.record.inputs, self.vector + vector)

    def _change(self, response: FloatArray) -> FloatArray:
        scaled = response * (self.scale if response.ndim == 2 else self.scale[:, None])
        return scaled if np.all(np.isfinite(scaled)) else np.zeros_like(scaled)


def means(signal: FloatArray, windows: FloatArray) -> FloatArray:
    """Means of a signal (n_samples,), straight in between, over windows (n_samples, 2) in samples.

    >>> windows = np.array([[0.0, 0.0], [-1.0, 0.0], [-2.0, -1.0]])
    >>> means(np.array([0.0, 1.0, 5.0]), windows)
    array([0. , 0.5, 0.5])
    """
    pieces = 0.5 * (signal[1:] + signal[:-1])
    integral = np.append(0.0, np.cumsum(pieces))
    whole: FloatArray = average(signal[:, None], integral[:, None], np.ascontiguousarray(windows))
    return whole[:, 0]
