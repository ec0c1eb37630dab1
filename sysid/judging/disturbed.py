"""How outputs move when something is added to a model's equations, without a model of its own.

Of dx/dt = f(x, u, p) + eps phi(x, u) the outputs move by eps times the response of the linearised
equations to the signal phi(x(t), u(t)) along the undisturbed run, but for terms of eps^2. So the
Jacobians of one run tell what any function in any equation would do.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy import ndimage

from sysid.arrays import FloatArray
from sysid.engine.linear_response import LinearResponse, feedthrough, free_response, observed
from sysid.engine.trace import rates_along
from sysid.engine.windows import average, with_integrals
from sysid.fitting.reactions import with_reactions
from sysid.judging.input_noise import likely_noise, not_following, quieted
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel
from sysid.problem.preparation import at_places
from sysid.threads import Workers

_FINE = 4  # steps of the integration in a sample, for what is to differ from another run alone
_BEYOND = 12  # samples by which a signal goes straight on, to be shifted: splines forget in fewer
_FELT = 1e-3  # part of an output's motion that inputs without noise do at least, or it is none


@dataclass(frozen=True, eq=False)
class Rates:
    """Rates of the states just after each sample and just before it, (n_samples, n_states) each.

    Or several, (n_samples, n_states, k). Straight from the one to the other; inputs that are held
    jump at samples. Of what a feedback has made an input of a sample acts after it alone: noise of
    that sample is in the input as well.
    """

    after: FloatArray
    before: FloatArray

    @classmethod
    def together(cls, several: Sequence["Rates"]) -> Self:
        """Rates of which each is by itself, as several."""
        return cls(
            np.stack([rates.after for rates in several], axis=2),
            np.stack([rates.before for rates in several], axis=2),
        )

    def __sub__(self, rates: "Rates") -> "Rates":
        return Rates(self.after - rates.after, self.before - rates.before)

    def __mul__(self, factor: float | FloatArray) -> "Rates":
        return Rates(self.after * factor, self.before * factor)


def delayed(signal: FloatArray) -> FloatArray:
    """A signal (n_samples, ...) by a sample later."""
    return np.concatenate([signal[:1], signal[:-1]])


@dataclass(eq=False)
class DisturbedRun:
    """A free run of a record under parameters (n_parameters,), and what disturbances change.

    It is driven by what of the inputs is not likely to be their noise, so that what it shows moves
    by nothing that errors go with. measured: (n_samples, n_inputs), the inputs with that noise.
    start: (n_states,), where it begins; response: along it. states: (n_samples, n_states) and
    outputs: (n_samples, n_outputs) of the undisturbed run, these over the record's windows. rates:
    (n_samples, n_states), its f(x, u, p). colour: (n_inputs,), part of the inputs' noise that goes
    on from sample to sample. workers: that runs share, to be disturbed side by side.
    """

    model: ProcessModel
    vector: FloatArray
    record: Dataset
    measured: FloatArray
    start: FloatArray
    response: LinearResponse
    colour: FloatArray
    workers: Workers

    @classmethod
    def free(
        cls,
        model: ProcessModel,
        vector: FloatArray,
        record: Dataset,
        start: FloatArray,
        n_steps: int,
        workers: Workers,
    ) -> "DisturbedRun":
        """A free run of what was measured; n_steps: in a sample, as of ``free_response``.

        Raises ModelError where it does not stay finite.
        """
        measured, record = record.inputs, quieted(record)
        averaged = _averaged(record)
        whole = with_integrals(model, averaged) if averaged else model
        begin = np.append(start, np.zeros(len(averaged)))
        response = free_response(whole, vector, record.inputs, record.dt, n_steps, begin)
        white = np.zeros(record.inputs.shape[1])
        return cls(model, vector, record, measured, start, response, white, workers)

    def __post_init__(self) -> None:
        self.states = self.response.states[:, : len(self.model.states)]
        self.outputs = self.over(self.record.windows)
        (self.rates,) = rates_of_each([self], self.model.derivative, self.vector)

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

    def mean(self, j: int) -> FloatArray:
        """Change (n_samples,) of output j by being its mean since the sample before, if it is none.

        Raises ModelError where a run in finer steps does not stay finite.
        """
        if j in self._averaged:
            return np.zeros(len(self.outputs))
        windows = np.zeros((*self.outputs.shape, 2))
        windows[:, j, 0] = -self.record.dt
        record = replace(self.record, inputs=self.measured, windows=windows)
        start, workers = self.start, self.workers
        run = DisturbedRun.free(self.model, self.vector, record, start, _FINE, workers)
        change: FloatArray = run.outputs[:, j] - self.outputs[:, j]
        return change

    def over(self, windows: FloatArray) -> FloatArray:
        """The undisturbed outputs over other windows, (n_samples, n_outputs, 2)."""
        integrals = self.response.states[:, len(self.model.states) :]
        instants = observed(self.model, self.states, self.record.inputs, self.vector)
        return self._as_measured(np.hstack([instants, integrals]), windows)

    @cached_property
    def inputs_before(self) -> FloatArray:
        """Inputs just before each sample, (n_samples, n_inputs)."""
        inputs, held = self.record.inputs, [given.hold == "zoh" for given in self.model.inputs]
        before: FloatArray = np.where(held, delayed(inputs), inputs)
        return before

    def added(self, rates: Rates) -> FloatArray:
        """Change of the outputs, (n_samples, n_outputs), per unit of what is added to the rates.

        Of several (n_samples, n_outputs, k).
        """
        return self._change(self.response.of(rates=rates.after, before=rates.before))

    def driven(self, inputs: FloatArray) -> FloatArray:
        """Change of the outputs per unit of a change of the inputs, (n_samples, n_inputs)."""
        outputs = np.einsum("kji,ki->kj", self._feedthrough, inputs)
        return self._change(self.response.of(inputs=inputs, outputs=outputs))

    def acted_before(self, i: int, signal: FloatArray, time: float) -> FloatArray:
        """Change of the outputs where of a held input i a signal has acted so much [s] before.

        Of the two values that it then has within a sample one acts throughout, and what the other
        adds at the begin or the end is in part even and in part a jump of the states, of the same
        mean and centre: fast states forget what was at the begin.
        """
        samples = time / self.record.dt
        whole = math.floor(samples)
        part, places, last = samples - whole, np.arange(len(signal)) + whole, len(signal) - 1
        at_begin, at_end = (
            self._put(i, signal[np.clip(at, 0, last)] - signal) for at in (places, places + 1)
        )
        added = self.rates_by(at_end) - self.rates_by(at_begin)
        even = part**2 if part < 0.5 else 2.0 * part - part**2
        jump = (part - even) * self.record.dt * added
        none = np.zeros_like(jump)
        jumps = (delayed(jump), none) if part < 0.5 else (none, jump)
        jumped = self._change(self.response.of(jumps=jumps))
        return self.driven((1.0 - even) * at_begin + even * at_end) + jumped

    def _put(self, i: int, signal: FloatArray) -> FloatArray:
        """A signal (n_samples,) in the place of input i, nothing in the others."""
        inputs = np.zeros_like(self.record.inputs)
        inputs[:, i] = signal
        return inputs

    def rates_by(self, inputs: FloatArray) -> FloatArray:
        """Rates just after each sample, (n_samples, n_states), by what is added to the inputs."""
        moved = self.record.inputs + inputs
        return rates_along(self.model.derivative, self.states, moved, self.vector)

    def likely_noise(self, i: int) -> FloatArray:
        """What of input i is likely to be noise, (n_samples,): nothing that follows the motion.

        Of a signal below its noise much is taken for noise, which what is tested may go with. Such
        a signal follows what inputs without noise do.
        """
        signal, noisy = self.measured[:, i], self.record.input_noise > 0.0
        if np.ptp(self.record.inputs[:, ~noisy], axis=0).any():
            moving = np.where(noisy, self.record.inputs - self.record.inputs.mean(axis=0), 0.0)
            without = self.outputs - self.driven(moving)
            felt = without.std(axis=0) > _FELT * self.outputs.std(axis=0)
            signal = not_following(signal, without[:, felt])
        return likely_noise(signal, float(self.record.input_noise[i]))

    def logged(self, outputs: FloatArray) -> FloatArray:
        """Change by what is logged of the outputs beside what they are: that itself."""
        return outputs

    def reacted(self) -> FloatArray:
        """Change of the outputs by what inputs on which states react are but straight lines."""
        record = with_reactions(self.model, self.record, self.vector, self.start)
        if not record.between.size:
            return np.zeros_like(self.outputs)
        return self._change(self.response.of(held=record.between))

    def started(self, place: int) -> FloatArray:
        """Change of the outputs per unit of where a state starts, (n_samples, n_outputs)."""
        return self._change(self.response.of(start=np.eye(len(self.model.states))[place]))

    @cached_property
    def _averaged(self) -> list[int]:
        return _averaged(self.record)  # asked for with each change

    @cached_property
    def _feedthrough(self) -> FloatArray:
        """Slopes of the outputs at their instants over the inputs, (n_samples, n_outputs, ...)."""
        return feedthrough(self.model, self.states, self.record.inputs, self.vector)

    def _change(self, response: FloatArray) -> FloatArray:
        """A response as changes of the outputs, none where it is not finite."""
        change = self._as_measured(response, self.record.windows)
        return change if np.all(np.isfinite(change)) else np.zeros_like(change)

    def _as_measured(self, response: FloatArray, windows: FloatArray) -> FloatArray:
        """Outputs, of a run or what changes in them, averaged ones by their integrals behind."""
        n, count = len(response), len(self.model.outputs)
        outputs, integrals = response[:, :count].copy(), response[:, count:] / self.record.dt
        for place, j in enumerate(self._averaged):
            values, areas = (
                np.ascontiguousarray(table.reshape(n, -1))
                for table in (outputs[:, j], integrals[:, place])
            )
            means = average(values, areas, windows[:, j] / self.record.dt)
            outputs[:, j] = means.reshape(outputs[:, j].shape)
        return outputs


def _averaged(record: Dataset) -> list[int]:
    """Places of the outputs that are means over windows."""
    windows = record.windows
    return np.flatnonzero(windows.any(axis=(0, 2))).tolist() if windows.size else []


def shifted(signal: FloatArray, samples: float, held: bool) -> FloatArray:
    """Change of a signal that is taken so many samples later, (n_samples,)."""
    if held:
        places = np.clip(np.arange(len(signal)) + samples, 0.0, len(signal) - 1.0)
        return at_places(signal, places, held) - signal
    # Splines of evenly spaced samples, which go straight on beyond their ends.
    padded = np.pad(signal, _BEYOND, mode="reflect", reflect_type="odd")
    later: FloatArray = ndimage.shift(padded, -samples, order=3, mode="nearest")
    return later[_BEYOND:-_BEYOND] - signal


def rates_of_each(
    runs: Sequence[DisturbedRun], derivative: Callable[..., Any], vector: FloatArray
) -> list[Rates]:
    """Values of a derivative along each run, NaN where it fails: side by side, which is sooner."""
    states, after, before = (
        np.concatenate(parts)
        for parts in zip(*((r.states, r.record.inputs, r.inputs_before) for r in runs), strict=True)
    )
    ends = np.cumsum([len(run.states) for run in runs])[:-1]
    sides = (np.split(rates_along(derivative, states, u, vector), ends) for u in (after, before))
    return [Rates(*pair) for pair in zip(*sides, strict=True)]


def of_each(
    runs: Sequence[DisturbedRun], change: Callable[..., FloatArray], *parts: Sequence[Any]
) -> FloatArray:
    """Changes (n_rows, n_outputs) of all runs, records one after another.

    parts: what a change is told of each run beside it.
    """
    tasks = list(zip(runs, *parts, strict=True))
    return np.concatenate(runs[0].workers.results(lambda task: change(*task), tasks))
