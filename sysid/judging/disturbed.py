"""How outputs move when something is added to a model's equations, without a model of its own.

Of dx/dt = f(x, u, p) + eps phi(x, u) the outputs move by eps times the response of the linearised
equations to the signal phi(x(t), u(t)) along the undisturbed run, but for terms of eps^2. So one
compiled model with a further input added to every equation tells what any function in any
equation would do: the function's values along the run are that input's samples.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.stepper import Stepper
from sysid.engine.trace import rates_along
from sysid.engine.windows import average, with_integrals
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ModelError, ProcessModel
from sysid.problem.preparation import at_places
from sysid.threads import Workers

_ACCURACY = 1e-6
_BASE_STEPS = 2
_SMALL = 1e-3  # a disturbance in parts of what it is added to


@functools.lru_cache(maxsize=8)  # one model for all records: its kernels are kept by it
def with_added_inputs(model: ProcessModel) -> ProcessModel:
    """The model with an input added to each state's rate, and all its states among the outputs.

    >>> from sysid.examples import lag
    >>> with_added_inputs(lag()).derivative((1.0,), (0.0, 7.0), (2.0, 0.5))
    (5.0,)
    """
    n, derivative, output = len(model.inputs), model.derivative, model.output
    names = set(model.output_names)
    states = [name for name in model.state_names if name not in names]
    whole = model.with_outputs([*model.output_names, *states])
    whole_output = whole.output if output is not None else None
    added = tuple(Input(f"added to d{s.name}/dt", f"{s.unit}/s", "foh") for s in model.states)
    total = _sum(len(model.states))

    def rates(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return total(derivative(x, u[:n], p), u[n:])

    def outputs(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        return whole_output(x, u[:n], p)  # type: ignore[misc]

    return replace(
        whole,
        inputs=model.inputs + added,
        derivative=rates,
        output=None if whole_output is None else outputs,
    )


def _sum(n: int) -> Callable[[Any, Any], tuple[Any, ...]]:
    """Sum of two tuples of n numbers, in a form that compiles."""
    last = n - 1
    if n == 1:
        return lambda a, b: (a[last] + b[last],)
    first = _sum(last)
    return lambda a, b: (*first(a, b), a[last] + b[last])


@dataclass(eq=False)
class DisturbedRun:
    """A free run of a record under parameters (n_parameters,), and what disturbances change.

    start: (n_states,), where it begins. states: (n_samples, n_states) and outputs: (n_samples,
    n_outputs) of the undisturbed run, these over the record's windows. rates: (n_samples,
    n_states), its f(x, u, p). workers: that runs share, to be disturbed side by side. Raises
    ModelError where the run does not stay finite.
    """

    model: ProcessModel
    vector: FloatArray
    record: Dataset
    start: FloatArray
    workers: Workers = field(default_factory=lambda: Workers(1))

    def __post_init__(self) -> None:
        windows, whole = self.record.windows, with_added_inputs(self.model)
        self._averaged: list[int] = []
        if windows.size:
            self._averaged = np.flatnonzero(windows.any(axis=(0, 2))).tolist()
            whole = with_integrals(whole, self._averaged) if self._averaged else whole
        places = [whole.output_names.index(name) for name in self.model.state_names]
        scale = np.maximum(np.abs(self.start), 1e-3)
        # A first run tells the states' magnitudes, by which accuracy is measured.
        for _ in range(2):
            self._stepper = Stepper(
                whole,
                self.vector,
                self.record.dt,
                n_steps=_BASE_STEPS,
                scale=np.append(scale, np.full(len(self._averaged), np.inf)),
                accuracy=_ACCURACY,
            )
            whole_run = self._advance(self.record.inputs, 0.0)
            if not np.all(np.isfinite(whole_run)):
                raise ModelError(f"model {self.model.name}: its run on {self.record.name} fails")
            self.states = whole_run[:, places]
            largest = np.abs(self.states).max(axis=0)
            scale = np.where(largest > 0.0, largest, 1.0)
        self._whole_run = whole_run
        self.outputs = self._as_measured(whole_run)
        self.rates = self.rates_of(self.model.derivative, self.vector)
        self._rate_size = np.sqrt(np.mean(self.rates**2, axis=0))

    @property
    def colour(self) -> FloatArray:
        """Part of the inputs' noise that goes on from sample to sample, (n_inputs,): none."""
        return np.zeros(self.record.inputs.shape[1])

    @property
    def instants(self) -> FloatArray:
        """The undisturbed outputs as ``averaged`` takes them, (n_samples, n_outputs)."""
        return self.outputs

    def averaged(self, j: int, signal: FloatArray) -> FloatArray:
        """A change (n_samples,) of output j as its sensor shows it: of what that has averaged."""
        return signal

    def late(self, j: int, delay: float) -> FloatArray:
        """Change (n_samples,) of output j by so many seconds that it comes late."""
        return shifted(self.outputs[:, j], -delay / self.record.dt, False)

    def over(self, windows: FloatArray) -> FloatArray:
        """The undisturbed outputs over other windows, (n_samples, n_outputs, 2)."""
        return self._as_measured(self._whole_run, windows)

    def rates_of(self, derivative: Callable[..., Any], vector: FloatArray) -> FloatArray:
        """Values of another derivative along the run, (n_samples, n_states), NaN where it fails."""
        return rates_along(derivative, self.states, self.record.inputs, vector)

    def added(self, rates: FloatArray) -> FloatArray:
        """Change of the outputs per unit of what is added to the rates, both (n_samples, ...)."""
        size = np.sqrt(np.mean(rates**2, axis=0))
        moving = size > 0.0
        if not (moving & (self._rate_size > 0.0)).any() or not np.all(np.isfinite(rates)):
            return np.zeros_like(self.outputs)
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = np.where(moving & (self._rate_size > 0.0), self._rate_size / size, np.inf)
        eps = _SMALL * float(parts.min())
        return self._change(self.record.inputs, eps * rates, eps)

    def driven(self, inputs: FloatArray) -> FloatArray:
        """Change of the outputs per unit of a change of the inputs, (n_samples, n_inputs)."""
        size = float(np.max(np.sqrt(np.mean(inputs**2, axis=0))))
        given = np.sqrt(np.mean(self.record.inputs**2, axis=0))
        changed = np.any(inputs != 0.0, axis=0)
        if size == 0.0 or not changed.any():
            return np.zeros_like(self.outputs)
        eps = _SMALL * (float(given[changed].max()) or 1.0) / size
        return self._change(self.record.inputs + eps * inputs, 0.0, eps)

    def logged(self, outputs: FloatArray) -> FloatArray:
        """Change by what is logged of the outputs beside what they are: that itself."""
        return outputs

    def started(self, place: int) -> FloatArray:
        """Change of the outputs per unit of where a state starts, (n_samples, n_outputs)."""
        start, eps = self.start.copy(), _SMALL * float(np.abs(self.states[:, place]).max() or 1.0)
        start[place] += eps
        moved = self._as_measured(self._advance(self.record.inputs, 0.0, start))
        change: FloatArray = (moved - self.outputs) / eps
        return change if np.all(np.isfinite(change)) else np.zeros_like(self.outputs)

    def _change(self, inputs: FloatArray, rates: FloatArray | float, eps: float) -> FloatArray:
        disturbed = self._as_measured(self._advance(inputs, rates))
        change: FloatArray = (disturbed - self.outputs) / eps
        return change if np.all(np.isfinite(change)) else np.zeros_like(self.outputs)

    def _advance(
        self, inputs: FloatArray, rates: FloatArray | float, start: FloatArray | None = None
    ) -> FloatArray:
        """Outputs of the model with added inputs, (n_samples, n_outputs of it)."""
        added = np.broadcast_to(rates, (len(inputs), len(self.model.states)))
        signals = np.hstack([inputs, added])
        # Outputs stand at the start of every interval: the last row begins one that goes nowhere.
        signals = np.vstack([signals, signals[-1:]])
        begin = self.start if start is None else start
        integrals = np.zeros(len(self._averaged))
        return self._stepper.advance(np.append(begin, integrals), np.ascontiguousarray(signals))[1]

    def _as_measured(self, whole_run: FloatArray, windows: FloatArray | None = None) -> FloatArray:
        """The model's outputs, averaged ones over windows, the record's or others."""
        windows = self.record.windows if windows is None else windows
        outputs = whole_run[:, : len(self.model.outputs)].copy()
        integrals = whole_run[:, whole_run.shape[1] - len(self._averaged) :] / self.record.dt
        for j, integral in zip(self._averaged, integrals.T, strict=True):
            within = windows[:, j] / self.record.dt
            outputs[:, j] = average(outputs[:, [j]], integral[:, None], within)[:, 0]
        return outputs


def shifted(signal: FloatArray, samples: float, held: bool) -> FloatArray:
    """Change of a signal that is taken so many samples later."""
    places = np.clip(np.arange(len(signal)) + samples, 0.0, len(signal) - 1.0)
    return at_places(signal, places, held) - signal


def of_each(
    runs: Sequence[DisturbedRun], change: Callable[[DisturbedRun], FloatArray]
) -> FloatArray:
    """Changes (n_rows, n_outputs) of all runs, records one after another."""
    return np.concatenate(runs[0].workers.results(change, runs))
