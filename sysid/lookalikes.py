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

from sysid.linearization import jacobian
from sysid.model import BoolArray, FloatArray
from sysid.objective import Objective

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
    if mode.imag * dt < 2.0 * np.pi * _FASTEST_SEEN:
        return []
    every = np.ones(len(modes.start), dtype=bool)
    found = []
    for frequency in _folded(mode.imag, dt):
        at, value = modes.start, mode
        for stage in np.linspace(0.0, 1.0, _STAGES + 1)[1:]:
            wanted = complex(mode.real, mode.imag * (frequency / mode.imag) ** stage)
            at, value = modes.towards(at, value, wanted, every)
        if abs(value.imag - frequency) < _REACHED * frequency:
            found.append(modes.space.decode(at))
    return found


def _twins(modes: _Modes) -> list[FloatArray]:
    """With one of the parameters that the mode hangs on moved, the others keeping the mode."""
    mode, found = modes.fastest, []
    for place in modes.acting[:_TURNED]:
        others = np.arange(len(modes.start)) != place
        for share in _TURNS:
            at = modes.start.copy()
            at[place] += share * modes.width[place]
            if not modes.bounds[0][place] <= at[place] <= modes.bounds[1][place]:
                continue
            value = modes.nearest(at, mode)
            at, value = modes.towards(at, value, mode, others, _STAGES * _ITERATIONS)
            if abs(value - mode) < _REACHED * abs(mode):
                found.append(modes.space.decode(at))
    return found


def _folded(frequency: float, dt: float) -> list[float]:
    """Frequencies [rad/s] that look like this one at a sample time, nearest first."""
    rate = 2.0 * np.pi / dt
    count = int(_REACH * frequency / rate) + 2
    several = np.arange(-count, count + 1) * rate
    all_of_them = np.abs(np.concatenate([frequency + several, several - frequency]))
    apart = np.abs(all_of_them - frequency) > 1e-6 * frequency
    near = (all_of_them < _REACH * frequency) & (all_of_them > frequency / _REACH)
    chosen = np.unique(all_of_them[apart & near])
    order = np.argsort(np.abs(np.log(chosen / frequency)))
    return [float(value) for value in chosen[order][:_MOST]]


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
        values = self._eigenvalues(self.start)
        oscillates = bool(values.imag.max() > 0.0)
        self.fastest = complex(values[np.argmax(values.imag if oscillates else np.abs(values))])
        self.acting = np.arange(len(self.start))
        size = np.linalg.norm(self.slopes(self.start, self.fastest), axis=0)
        strongest = np.argsort(size)[::-1]
        self.acting = strongest[size[strongest] > _ACTING * size.max()]

    def towards(
        self, at: FloatArray, value: complex, wanted: complex, moving: BoolArray,
        iterations: int = _ITERATIONS,
    ) -> tuple[FloatArray, complex]:  # fmt: skip
        """The least move, in parts of the ranges, that brings a mode where it is wanted."""
        for _ in range(iterations):
            slopes = np.where(moving, self.slopes(at, value), 0.0)
            miss = np.array([wanted.real - value.real, wanted.imag - value.imag])
            move = np.linalg.lstsq(slopes, miss, rcond=1e-9)[0]
            at = np.clip(at + move * self.width, *self.bounds)
            value = self.nearest(at, value + complex(*(slopes @ move)))
        return at, value

    def slopes(self, at: FloatArray, value: complex) -> FloatArray:
        """How real and imaginary part move per range of each coordinate, (2, n_free)."""
        slopes = np.zeros((2, len(at)))
        for i in self.acting:
            shift = -_DIFFERENCE if at[i] + _DIFFERENCE * self.width[i] > self.bounds[1][i] else (
                _DIFFERENCE
            )  # fmt: skip
            beside = at.copy()
            beside[i] += shift * self.width[i]
            change = (self.nearest(beside, value) - value) / shift
            slopes[:, i] = change.real, change.imag
        return slopes

    def nearest(self, at: FloatArray, value: complex) -> complex:
        """The eigenvalue nearest to a value."""
        values = self._eigenvalues(at)
        return complex(values[np.argmin(np.abs(values - value))])

    def _eigenvalues(self, at: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.complex128]]:
        vector = self.space.full(self.space.decode(at))
        matrix = jacobian(self.model, self.x, self.u, vector)
        return np.linalg.eigvals(np.where(np.isfinite(matrix), matrix, 0.0)).astype(np.complex128)
