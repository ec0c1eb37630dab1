"""Parameters far from a minimum under which a model's fastest mode looks the same.

Through the sampling: a mode of rate -s +- jw, sampled every dt, has the multiplier
exp((-s +- jw) dt), and so do modes of w + 2 pi k / dt and of 2 pi k / dt - w. A model that rings
faster than half the sample rate therefore has one minimum for each k, far apart in its parameters.
And in itself: the mode of a driver and of what it drives stays as it is when their time constants
swap roles. Such starts for descents need not be searched for, they follow from the eigenvalues of
the linearised model.
"""

from __future__ import annotations

import itertools

import numpy as np

from sysid.arrays import BoolArray, ComplexArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.response.linearization import jacobians

_FASTEST_SEEN = 0.4  # of the sample rate: slower modes have no alias that could be mistaken
_REACH = 2.0  # how many times faster or slower than the mode its aliases may be
_MOST = 6
_STAGES, _ITERATIONS = 3, 2  # on the way to the alias, Newton steps at each
_HARM = 2.0  # times the error that a swap may cost before its descent
_TURNED = 3  # parameters that are moved to find twins
_TURNS = (-0.3, -0.15, 0.15, 0.3)  # by these parts of their ranges
_DIFFERENCE = 1e-6
_ACTING = 1e-4  # parameters that move the mode less than this part of what the strongest does
_REACHED = 0.02  # part of the frequency by which the end may miss the alias


def lookalikes(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes (n_free,) whose fastest mode is this one's, or an alias of it.

    The model is linearised where the first record starts. What the ranges do not admit is left
    out.
    """
    modes = _Modes(objective, chromosome)
    dt = objective.records[0].dt
    return [*_swaps(objective, chromosome), *_twins(modes), *_aliases(modes, dt)]


def _swaps(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """With two parameters of a unit changed for each other, where that does little harm."""
    space = objective.space
    units = [parameter.unit for parameter in space.parameters[: len(space.index)]]
    pairs = [
        (i, j) for i, j in itertools.combinations(range(len(units)), 2) if units[i] == units[j]
    ]
    swapped = np.repeat(chromosome[None], len(pairs) + 1, axis=0)
    for row, (i, j) in zip(swapped, pairs, strict=False):
        row[[i, j]] = row[[j, i]]
    coded = space.encode(np.maximum(swapped, np.finfo(np.float64).tiny * space.log))
    lower, upper = space.coded_bounds
    admitted = np.all((coded >= lower) & (coded <= upper), axis=1)
    errors, _ = objective.evaluate(np.where(admitted[:, None], swapped, chromosome))
    # The last one is the chromosome itself.
    kept = admitted & (errors < _HARM * errors[-1])
    return [swapped[k] for k in np.flatnonzero(kept[:-1])]


def _aliases(modes: _Modes, dt: float) -> list[FloatArray]:
    """With the mode at the frequencies that the sampling does not tell from its own."""
    mode = modes.fastest
    frequencies = _folded(mode.imag, dt)
    if mode.imag * dt < 2.0 * np.pi * _FASTEST_SEEN or not len(frequencies):
        return []
    at, values = modes.here(len(frequencies))
    for stage in np.linspace(0.0, 1.0, _STAGES + 1)[1:]:
        wanted = mode.real + 1j * mode.imag * (frequencies / mode.imag) ** stage
        at, values = modes.towards(at, values, wanted, np.ones(at.shape, dtype=bool))
    reached = np.abs(values.imag - frequencies) < _REACHED * frequencies
    return list(modes.space.decode(at[reached]))


def _twins(modes: _Modes) -> list[FloatArray]:
    """With one of the parameters that the mode hangs on moved, the others keeping the mode."""
    mode = modes.fastest
    places = np.repeat(modes.acting[:_TURNED], len(_TURNS))
    at, _ = modes.here(len(places))
    rows = np.arange(len(places))
    at[rows, places] += np.tile(_TURNS, len(places) // len(_TURNS)) * modes.width[places]
    moved, (lower, upper) = at[rows, places], modes.bounds
    inside = (moved >= lower[places]) & (moved <= upper[places])
    at, places = at[inside], places[inside]
    if not len(at):
        return []
    others = np.arange(at.shape[1]) != places[:, None]
    wanted = np.full(len(at), mode)
    values = modes.nearest(at, wanted)
    at, values = modes.towards(at, values, wanted, others, _STAGES * _ITERATIONS)
    return list(modes.space.decode(at[np.abs(values - mode) < _REACHED * abs(mode)]))


def _folded(frequency: float, dt: float) -> FloatArray:
    """Frequencies [rad/s] that look like this one at a sample time, nearest first."""
    rate = 2.0 * np.pi / dt
    count = int(_REACH * frequency / rate) + 2
    several = np.arange(-count, count + 1) * rate
    all_of_them = np.abs(np.concatenate([frequency + several, several - frequency]))
    apart = np.abs(all_of_them - frequency) > 1e-6 * frequency
    near = (all_of_them < _REACH * frequency) & (all_of_them > frequency / _REACH)
    chosen = np.unique(all_of_them[apart & near])
    order = np.argsort(np.abs(np.log(chosen / frequency)))
    nearest: FloatArray = chosen[order][:_MOST]
    return nearest


class _Modes:
    """Eigenvalues of the linearised model over the search coordinates.

    start: search coordinates (n_free,) of the minimum. fastest: the eigenvalue there of largest
    imaginary part, or where nothing oscillates of largest size. acting: places of the parameters
    that it hangs on, the strongest first; the others need no differences of their own.
    """

    def __init__(self, objective: Objective, chromosome: FloatArray) -> None:
        self.space, self.model = objective.space, objective.simulator.model
        record = objective.records[0]
        own = record.initial_state(self.model)
        self.x = self.space.starts(chromosome[None], 0, own)[0]
        self.u = record.inputs[0]
        self.start = self.space.encode(chromosome)
        self.bounds = self.space.coded_bounds
        self.width = self.space.width
        (values,) = self._eigenvalues(self.start[None])
        oscillates = bool(values.imag.max() > 0.0)
        self.fastest = complex(values[np.argmax(values.imag if oscillates else np.abs(values))])
        self.acting = np.arange(len(self.start))
        (slopes,) = self.slopes(*self.here(1))
        size = np.linalg.norm(slopes, axis=0)
        strongest = np.argsort(size)[::-1]
        self.acting = strongest[size[strongest] > _ACTING * size.max()]

    def here(self, count: int) -> tuple[FloatArray, ComplexArray]:
        """The minimum and its fastest mode, so many times."""
        return np.repeat(self.start[None], count, axis=0), np.full(count, self.fastest)

    def towards(
        self, at: FloatArray, values: ComplexArray, wanted: ComplexArray, moving: BoolArray,
        iterations: int = _ITERATIONS,
    ) -> tuple[FloatArray, ComplexArray]:  # fmt: skip
        """The least moves, in parts of the ranges, that bring modes where they are wanted.

        at, moving: (n, n_free); values, wanted: (n,).
        """
        for _ in range(iterations):
            slopes = np.where(moving[:, None], self.slopes(at, values), 0.0)
            miss = np.stack([(wanted - values).real, (wanted - values).imag], axis=1)
            move = np.linalg.pinv(slopes, rcond=1e-9) @ miss[:, :, None]
            along = (slopes @ move)[:, :, 0]
            at = np.clip(at + move[:, :, 0] * self.width, *self.bounds)
            values = self.nearest(at, values + along[:, 0] + 1j * along[:, 1])
        return at, values

    def slopes(self, at: FloatArray, values: ComplexArray) -> FloatArray:
        """How real and imaginary parts move per range of each coordinate, (n, 2, n_free)."""
        n, count = len(at), len(self.acting)
        back = at + _DIFFERENCE * self.width > self.bounds[1]
        shift = np.where(back, -_DIFFERENCE, _DIFFERENCE)
        beside = np.repeat(at[:, None], count, axis=1)
        beside[:, np.arange(count), self.acting] += (shift * self.width)[:, self.acting]
        found = self.nearest(beside.reshape(n * count, -1), np.repeat(values, count))
        change = (found.reshape(n, count) - values[:, None]) / shift[:, self.acting]
        slopes = np.zeros((n, 2, at.shape[1]))
        slopes[:, 0, self.acting], slopes[:, 1, self.acting] = change.real, change.imag
        return slopes

    def nearest(self, at: FloatArray, values: ComplexArray) -> ComplexArray:
        """At each row of coordinates the eigenvalue nearest to a value, (n,)."""
        found = self._eigenvalues(at)
        chosen = np.argmin(np.abs(found - values[:, None]), axis=1)
        nearest: ComplexArray = found[np.arange(len(at)), chosen]
        return nearest

    def _eigenvalues(self, at: FloatArray) -> ComplexArray:
        vectors = self.space.full(self.space.decode(at))
        matrices = jacobians(self.model, self.x, self.u, vectors)
        found = np.linalg.eigvals(np.where(np.isfinite(matrices), matrices, 0.0))
        return found.astype(np.complex128)
