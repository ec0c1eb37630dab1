"""How a filter's innovations move when something is added to a model's equations.

As of a free run (``disturbed``), along the filter's own estimate: where noise of the inputs leads
a free run far from where the plant was, functions of its states are none of the plant's, and what
they would do is bent. A filter knows where the plant is, and its innovations are white.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.filter_response import FilterResponse, slope_of
from sysid.engine.trace import evaluated, rates_along
from sysid.engine.windows import average
from sysid.fitting.innovations import Innovations
from sysid.judging.disturbed import DisturbedRun, shifted
from sysid.threads import Workers

_SMALL = 1e-6  # part of an input by which slopes of the rates over it are told


@dataclass(eq=False, kw_only=True)
class FilteredRun(DisturbedRun):
    """A filter's run of a record under parameters (n_parameters,), and what disturbances change.

    As a free run, with changes of the innovations, in the outputs' units, for those of the outputs.
    response: of the filter; scale: (n_outputs,), of the innovations in it; of_noise: (n_inputs,),
    the inputs' colour. states: (n_samples, n_states), what the filter foresees at each sample from
    those before, so that no function of it is of what was measured then; outputs: that over the
    record's windows.
    """

    response: FilterResponse
    scale: FloatArray
    of_noise: FloatArray

    @classmethod
    def of(
        cls,
        objective: Innovations,
        chromosome: FloatArray,
        place: int,
        response: FilterResponse,
        workers: Workers,
    ) -> Self:
        """The run of the record at a place; response: of its filter."""
        model, record = objective.simulator.model, objective.records[place]
        return cls(
            model,
            objective.space.full(chromosome[None])[0],
            record,
            record.initial_state(model),
            workers,
            response=response,
            scale=objective.scales[place],
            of_noise=objective.colour[place],
        )

    def __post_init__(self) -> None:
        self.states = self.response.states
        self.outputs = self.over(self.record.windows)
        self.rates = self.rates_of(self.model.derivative, self.vector)

    @property
    def colour(self) -> FloatArray:
        """Part of the inputs' noise that goes on from sample to sample, (n_inputs,)."""
        return self.of_noise

    def over(self, windows: FloatArray) -> FloatArray:
        """Outputs of these states over other windows, (n_samples, n_outputs, 2)."""
        outputs = self.instants.copy()
        for j in np.flatnonzero(windows.any(axis=(0, 2))).tolist() if windows.size else ():
            outputs[:, j] = means(outputs[:, j], windows[:, j] / self.record.dt)
        return outputs

    @cached_property
    def instants(self) -> FloatArray:
        """Outputs of these states at their instants, (n_samples, n_outputs)."""
        if self.model.output is None:
            return self.states[:, list(self.model.output_states or ())]
        return self._observed(0.0, 0.0)

    def averaged(self, j: int, signal: FloatArray) -> FloatArray:
        """A change (n_samples,) of output j at its instants as its sensor averages it."""
        windows = self._windows(j)
        return means(signal, windows / self.record.dt) if windows.any() else signal

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

    def added(self, rates: FloatArray) -> FloatArray:
        """Change per unit of what is added to the rates, both (n_samples, ...)."""
        return self._finite(self.response.of(rates=rates))

    def driven(self, inputs: FloatArray) -> FloatArray:
        """Change per unit of a change of the inputs, (n_samples, n_inputs)."""
        rates, held = np.zeros(self.states.shape), np.zeros(self.states.shape)
        for i in np.flatnonzero(np.any(inputs != 0.0, axis=0)).tolist():
            part = self._slopes[i] * inputs[:, [i]]
            if self.model.inputs[i].hold == "zoh":
                held += part
            else:
                rates += part
        outputs = None
        if self.model.output is not None:
            outputs = self._through(inputs)
        return self._finite(self.response.of(rates=rates, held=held, outputs=outputs))

    def logged(self, outputs: FloatArray) -> FloatArray:
        """Change by what is logged of the outputs beside what was foreseen, (n_samples, ...)."""
        return self._finite(self.response.of(outputs=outputs))

    def started(self, place: int) -> FloatArray:
        """Change per unit of where a state starts, (n_samples, n_outputs)."""
        return self._finite(self.response.of(start=np.eye(self.states.shape[1])[place]))

    def moved(self, vector: FloatArray, start: FloatArray) -> FloatArray:
        """Change by a change of the parameters (n_parameters,), and of the states' start."""
        outputs = None
        if self.model.output is not None:
            outputs = self._by_observation(vector)
        return self._finite(self.response.of(vector=vector, start=start, outputs=outputs))

    def _by_observation(self, vector: FloatArray) -> FloatArray:
        """Change of the outputs by that of the parameters in the output function itself."""
        size = np.max(np.abs(vector) / np.maximum(np.abs(self.vector), 1e-300), initial=0.0)
        if not size:
            return np.zeros(self.record.outputs.shape)
        return slope_of(lambda part: self._observed(0.0, part * vector), _SMALL / size)

    @cached_property
    def _slopes(self) -> list[FloatArray]:
        """Slopes of the rates over each input, (n_samples, n_states) each."""
        slopes = []
        for i in range(self.record.inputs.shape[1]):
            step = _SMALL * (float(np.abs(self.record.inputs[:, i]).max()) or 1.0)
            slopes.append(slope_of(partial(self._rates_by, i), step))
        return slopes

    def _rates_by(self, i: int, step: float) -> FloatArray:
        inputs = self.record.inputs.copy()
        inputs[:, i] += step
        return rates_along(self.model.derivative, self.states, inputs, self.vector)

    def _through(self, inputs: FloatArray) -> FloatArray:
        """Change of the outputs by that of the inputs at the same instant."""
        size = float(np.abs(inputs).max()) or 1.0
        eps = _SMALL * (float(np.abs(self.record.inputs).max()) or 1.0) / size
        return slope_of(lambda part: self._observed(part * inputs, 0.0), eps)

    def _observed(self, inputs: FloatArray | float, vector: FloatArray | float) -> FloatArray:
        """Outputs of the states with something added to the inputs, and to the parameters."""
        vectors = (self.vector + vector)[None]
        return evaluated(self.model.output, self.states, self.record.inputs + inputs, vectors)

    def _finite(self, change: FloatArray) -> FloatArray:
        scaled = change * self.scale
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
