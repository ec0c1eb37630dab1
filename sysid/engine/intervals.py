"""How a model's states at a sample follow from those at the sample before, one interval a lane.

Each interval of a run is simulated by itself, from the state it begins with and by what is a little
beside it. Differences of these are the Jacobian of the simulated step, of any model that compiles.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.compiler import explained_errors, interval_lanes
from sysid.engine.scheme import LANES, work_area
from sysid.problem.model import Input, ProcessModel

_STEP = 1e-6  # of differences, in parts of the largest value
_LEAST = 1e-6  # value that counts as that where there is none
# A state that switches within an interval makes one side of a difference endlessly steep: that is
# so many times the other side and what is usual.
_STEEP = 100.0


@functools.lru_cache(maxsize=8)  # one model for all records: its kernels are kept by it
def with_added_inputs(model: ProcessModel) -> ProcessModel:
    """The model with an input added to each state's rate.

    >>> from sysid.examples import lag
    >>> with_added_inputs(lag()).derivative((1.0,), (0.0, 7.0), (2.0, 0.5))
    (5.0,)
    """
    n, derivative = len(model.inputs), model.derivative
    added = tuple(Input(f"added to d{s.name}/dt", f"{s.unit}/s", "foh") for s in model.states)
    total = _sum(len(model.states))

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return total(derivative(x, u[:n], p), u[n:])

    output = model.output
    of_outputs = None if output is None else lambda x, u, p: output(x, u[:n], p)
    return replace(model, inputs=model.inputs + added, derivative=rates, output=of_outputs)


def _sum(n: int) -> Callable[[Any, Any], tuple[Any, ...]]:
    """Sum of two tuples of n numbers, in a form that compiles."""
    last = n - 1
    if n == 1:
        return lambda a, b: (a[last] + b[last],)
    first = _sum(last)
    return lambda a, b: (*first(a, b), a[last] + b[last])


class Intervals:
    """The intervals between the samples of a record, under parameters (n_parameters,).

    inputs: (n_samples, n_inputs). dt: between samples [s]; n_steps: of the integration in each.
    """

    def __init__(
        self, model: ProcessModel, vector: FloatArray, inputs: FloatArray, dt: float, n_steps: int
    ) -> None:
        self.model, self.vector, self.inputs = model, vector, inputs
        self.dt, self._n_steps = dt, n_steps
        self._lanes = interval_lanes(with_added_inputs(model))
        self.changing: list[int] = self._lanes.kernel.interpolated

    def causes(
        self,
        inputs: FloatArray | None = None,
        rates: FloatArray | None = None,
        before: FloatArray | None = None,
    ) -> FloatArray:
        """What acts in each interval, (n_samples - 1, n_causes).

        Inputs, (n_samples, n_inputs), at its begin and what is added to rates, (n_samples,
        n_states), or several of these, (n_samples, n_states, k), which may lack the last states;
        then those of these that are not held at its end. before: rates just before each sample,
        where these jump there.
        """
        begins = self._causes_at(inputs, rates)
        ends = begins if before is None else self._causes_at(inputs, before)
        return np.hstack([begins[:-1], ends[1:, self.changing]])

    def _causes_at(self, inputs: FloatArray | None, rates: FloatArray | None) -> FloatArray:
        n, n_inputs = len(self.inputs), len(self.model.inputs)
        several = () if rates is None else rates.shape[2:]
        causes = np.zeros((n, n_inputs + len(self.model.states), *several))
        if inputs is not None:
            causes[:, : inputs.shape[1]] = inputs
        if rates is not None:
            causes[:, n_inputs : n_inputs + rates.shape[1]] = rates
        return causes

    def held(self, inputs: FloatArray) -> FloatArray:
        """As of ``causes``, of inputs (n_samples, n_inputs) that stay as they are for an interval.

        >>> from sysid.examples import lag
        >>> u = np.array([[1.0], [2.0], [0.0]])
        >>> Intervals(lag().with_holds({"u": "foh"}), lag().nominal, u, 0.1, 1).held(u).tolist()
        [[1.0, 0.0, 1.0, 0.0], [2.0, 0.0, 2.0, 0.0]]
        """
        whole = np.zeros((len(inputs) - 1, len(self.model.inputs) + len(self.model.states)))
        whole[:, : inputs.shape[1]] = inputs[:-1]
        return np.hstack([whole, whole[:, self.changing]])

    def run(self, start: FloatArray) -> FloatArray:
        """States (n_samples, n_states) of a free run from where it begins, (n_states,)."""
        signals = np.repeat(self._signals(self.causes(self.inputs)), LANES, axis=1)
        ends = self._advanced(np.repeat(start, LANES)[None], signals, self.vector)
        return np.vstack([start, ends.reshape(len(ends), -1, LANES)[..., 0]])

    def ends(self, states: FloatArray, causes: FloatArray, vector: FloatArray) -> FloatArray:
        """States at the ends of intervals that begin with states, (n, n_states) each."""
        signals = _in_lanes(self._signals(causes))
        ends = self._advanced(_in_lanes(states), signals, vector)
        by_lane = ends.reshape(len(ends), -1, LANES).swapaxes(1, 2)
        return by_lane.reshape(-1, states.shape[1])[: len(states)]

    def _signals(self, causes: FloatArray) -> FloatArray:
        """Causes as of ``SampleKernel``: by how much inputs change, not where they end."""
        begin, end = np.split(causes, [causes.shape[1] - len(self.changing)], axis=1)
        return np.hstack([begin, end - begin[:, self.changing]])

    def _advanced(self, starts: FloatArray, signals: FloatArray, vector: FloatArray) -> FloatArray:
        """States at the ends of intervals, all of them as of ``IntervalKernel``."""
        kernel, step = self._lanes.kernel, self.dt / self._n_steps
        work = work_area(kernel.work_rows * LANES)
        begin = np.zeros((kernel.n_states, LANES))
        parameters = np.repeat(vector[:, None], LANES, axis=1)
        ends = np.empty((len(signals), starts.shape[1]))
        with explained_errors(self.model):
            self._lanes.prepare(
                work, work.reshape(-1, LANES), kernel.tables, begin, parameters, step
            )
            self._lanes.advance(work, starts, signals, step, self._n_steps, ends)
        return ends


class IntervalSlopes:
    """Slopes of the states at the ends of intervals, (n_samples - 1, n_causes, n_states).

    The mean of those for more of a cause and for less, where an interval lies on a kink. states:
    (n_samples, n_states), with which intervals begin.
    """

    def __init__(self, intervals: Intervals, states: FloatArray) -> None:
        self.intervals, self.states = intervals, states
        self._causes = intervals.causes(intervals.inputs)
        self._sizes = np.maximum(np.abs(states).max(axis=0), _LEAST)

    @cached_property
    def by_states(self) -> FloatArray:
        """Over the states at an interval's begin."""
        begins, vector = self.states[:-1], self.intervals.vector
        return self._slopes(
            lambda move: self.intervals.ends(begins + move, self._causes, vector),
            _STEP * self._sizes,
        )

    @cached_property
    def by_causes(self) -> FloatArray:
        """Over what acts, as of ``Intervals.causes``."""
        return self._by_causes_at(slice(None))

    def _by_causes_at(self, places: slice | list[int]) -> FloatArray:
        inputs = np.maximum(np.abs(self.intervals.inputs).max(axis=0, initial=0.0), _LEAST)
        # A rate counts by how far it moves a state.
        sizes = np.append(inputs, self._sizes / self.intervals.dt)
        steps = _STEP * np.append(sizes, sizes[self.intervals.changing])
        chosen = np.eye(len(steps))[places]
        begins, vector = self.states[:-1], self.intervals.vector
        return self._slopes(
            lambda move: self.intervals.ends(begins, self._causes + move @ chosen, vector),
            steps[places],
        )

    @cached_property
    def by_parameters(self) -> FloatArray:
        """Over the parameters."""
        begins, vector = self.states[:-1], self.intervals.vector
        return self._slopes(
            lambda move: self.intervals.ends(begins, self._causes, vector + move),
            _STEP * np.where(vector, np.abs(vector), 1.0),
        )

    def by_input(self, j: int) -> tuple[FloatArray, FloatArray]:
        """Over input j at an interval's begin and at its end, (n_samples - 1, n_states) each."""
        changing, inputs = self.intervals.changing, self.intervals.inputs.shape[1]
        if j not in changing:
            slopes = self._by_causes_at([j])
            return slopes[:, 0], np.zeros_like(slopes[:, 0])
        slopes = self._by_causes_at([j, inputs + self.states.shape[1] + changing.index(j)])
        return slopes[:, 0], slopes[:, 1]

    def _slopes(self, ends: Callable[[FloatArray], FloatArray], steps: FloatArray) -> FloatArray:
        """Slopes of ends over causes, (n_causes,), by a step of each both ways."""
        middle = ends(np.zeros(len(steps)))
        slopes = np.empty((len(middle), len(steps), middle.shape[1]))
        for i, move in enumerate(np.diag(steps)):
            slopes[:, i] = _mean(np.array([ends(move) - middle, middle - ends(-move)])) / steps[i]
        return slopes


def _in_lanes(rows: FloatArray) -> FloatArray:
    """Rows (n, m) side by side in blocks, (n_blocks, m * LANES), the last one repeated."""
    padded = rows.take(np.arange(-(-len(rows) // LANES) * LANES), axis=0, mode="clip")
    blocks = padded.reshape(-1, LANES, rows.shape[1]).swapaxes(1, 2)
    return np.ascontiguousarray(blocks).reshape(len(blocks), -1)


def _mean(sides: FloatArray) -> FloatArray:
    """Mean of differences (2, n, n_states) on both sides, but of a jump on one the other's."""
    sizes = np.linalg.norm(sides, axis=2)
    jumps = sizes > _STEEP * np.maximum(sizes[::-1], np.median(sizes))
    mean: FloatArray = np.where(jumps[..., None], sides[::-1], sides).mean(axis=0)
    return mean
