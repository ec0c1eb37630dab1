"""Parameters far from a minimum under which a model's fast modes look the same.

Through the sampling: a mode of rate -s +- jw, sampled every dt, has the multiplier
exp((-s +- jw) dt), and so do modes of w + 2 pi k / dt and of 2 pi k / dt - w. A model that rings
faster than half the sample rate therefore has one minimum for each k, far apart in its parameters.
And in itself: the mode of a driver and of what it drives stays as it is when their time constants
swap roles. Such starts for descents follow from the eigenvalues of the linearised model.

Where a model's states come to an end of a range, such as an amplifier's supply, outputs tell what
they do not tell elsewhere. At parameters with which that end is just not reached, or just is, the
error has a kink, on which noise makes a minimum of its own: what is better beyond it is found along
the directions that a model without ends leaves undetermined.

And what is hardly felt may have several minima in the noise of what is felt more.
"""

from __future__ import annotations

import copy
import itertools
from typing import Self

import numpy as np

from sysid.arrays import BoolArray, ComplexArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.gassi.responses import alike_directions, alike_responses
from sysid.response.linearization import linear_models

_FASTEST_SEEN = 0.4  # of the sample rate: slower modes have no alias that could be mistaken
_REACH = 2.0  # times that aliases may be faster or slower than the mode
_MOST_ALIASES = 6
_STAGES, _ITERATIONS = 3, 2  # on the way to the alias, Newton steps at each
_HARM = 2.0  # times the error that starts may have which are no more than worth a try
_LITTLE = 1.3  # the same of starts with one parameter moved
_TURNED = 3  # parameters that are moved to find twins
_TURNS = (-0.3, -0.15, 0.15, 0.3)  # by these parts of their ranges
_DIFFERENCE = 1e-6
_ACTING = 1e-4  # parameters that move the mode less than this part of what the strongest does
# A rate is a parameter's if it goes with at least its root, and no other's as fast as that.
_OWN, _FOREIGN = 0.5, 0.25
_REACHED = 0.02  # part of the frequency by which the end may miss the alias
_SCANNED = 8  # places along a direction that only ends of ranges tell
_LEAST = float(np.finfo(np.float64).tiny)
_SAME = 1e-5  # part of the error by which places that are as good may differ


def lookalikes(
    objective: Objective, chromosome: FloatArray, *, narrow: bool = False
) -> list[FloatArray]:
    """Chromosomes (n_free,) in the ranges of which a fast mode is this one's or an alias of it.

    narrow: whether a minimum lies in so narrow a valley that its errors are far less than all
    others. Lags traded are worth a try whatever theirs, and what only keeps a mode is none.
    """
    fastest, dt = _Modes(objective, chromosome), objective.records[0].dt
    swapped, alike = _swaps(objective, chromosome), alike_responses(objective, chromosome)
    traded, starts = _trades(fastest, chromosome), []
    if narrow:
        traded, starts = [], _harmless(objective, chromosome, traded, np.inf)
    starts += _harmless(objective, chromosome, [*swapped, *traded, *alike], _HARM)
    starts += _beyond_ends(objective, chromosome)
    for modes in (fastest, *fastest.others(2.0 * np.pi * _FASTEST_SEEN / dt)):
        starts += [*([] if narrow else _twins(modes)), *_aliases(modes, dt)]
    return starts


def _harmless(
    objective: Objective, chromosome: FloatArray, starts: list[FloatArray], harm: float
) -> list[FloatArray]:
    """Starts (n_free,) in the ranges whose error is less than so many times a chromosome's."""
    rows = np.stack([chromosome, *starts])
    # What is traded may come to zero, and a start that is no logarithm below it.
    log = objective.space.log
    coded = objective.space.encode(np.where(log, np.maximum(rows, _LEAST), rows))
    lower, upper = objective.space.coded_bounds
    admitted = np.all((coded >= lower) & (coded <= upper), axis=1)
    errors, _ = objective.evaluate(np.where(admitted[:, None], rows, chromosome))
    kept = admitted & (errors < harm * errors[0])
    return list(rows[1:][kept[1:]])


def _beyond_ends(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """The best along each direction that the linearised model does not show, where it is better.

    Of places that are as good the middle one.
    """
    space, starts = objective.space, []
    at, bounds = space.encode(chromosome), np.array(space.coded_bounds)
    for direction in alike_directions(objective, chromosome):
        moving = direction != 0.0
        ends = np.sort((bounds - at)[:, moving] / direction[moving], axis=0)
        places = np.linspace(ends[0].max(), ends[1].min(), _SCANNED)
        rows = space.decode(np.clip(at + places[:, None] * direction, *bounds))
        errors, _ = objective.evaluate(np.stack([chromosome, *rows]))
        best = errors[1:].min()
        if best < (1.0 - _SAME) * errors[0]:
            as_good = np.flatnonzero(errors[1:] <= (1.0 + _SAME) * best)
            starts.append(rows[as_good[len(as_good) // 2]])
    return starts


def hardly_felt(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes with one parameter moved, where that adds little to the error.

    What is hardly felt among other things' noise may have minima side by side, as a winding's and
    its driver's lag where a log is not made for them; the search has seen none of them.
    """
    space, starts = objective.space, []
    for turn in _TURNS:
        moved = space.decode(space.encode(chromosome) + turn * space.width)
        for place in range(len(space.index)):
            start = chromosome.copy()
            start[place] = moved[place]
            starts.append(start)
    return _harmless(objective, chromosome, starts, _LITTLE)


def _swaps(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes with two parameters of a unit swapped."""
    space = objective.space
    units = np.array([parameter.unit for parameter in space.parameters[: len(space.index)]])
    pairs = np.argwhere(np.triu(units[:, None] == units, 1))
    swapped = np.repeat(chromosome[None], len(pairs), axis=0)
    for row, pair in zip(swapped, pairs, strict=True):
        row[pair] = row[pair[::-1]]
    return list(swapped)


def _trades(modes: _Modes, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes with the rates of two lags traded, each through one parameter.

    As those of an amplifier and of the winding behind it, which outputs hardly tell apart.
    """
    rates, powers = modes.lags(chromosome)
    trades = []
    for i, j in itertools.combinations(range(len(rates)), 2):
        ratio = rates[j] / rates[i]
        ours, theirs = (
            np.flatnonzero((np.abs(powers[a]) > _OWN) & (np.abs(powers[b]) < _FOREIGN))
            for a, b in ((i, j), (j, i))
        )
        for k, m in itertools.product(ours, theirs):
            traded = chromosome.copy()
            with np.errstate(over="ignore"):  # beyond all ranges anyway
                traded[k] *= ratio ** (1.0 / powers[i, k])
                traded[m] *= ratio ** (-1.0 / powers[j, m])
            trades.append(traded)
    return trades


def _aliases(modes: _Modes, dt: float) -> list[FloatArray]:
    """Chromosomes with the mode at the frequencies that sampling does not tell from its own."""
    mode = modes.mode
    frequencies = _aliased(mode.imag, dt)
    slow = mode.imag * dt < 2.0 * np.pi * _FASTEST_SEEN
    if slow or not len(frequencies) or not len(modes.acting):
        return []
    at, values = modes.here(len(frequencies))
    for stage in np.linspace(0.0, 1.0, _STAGES + 1)[1:]:
        targets = mode.real + 1j * mode.imag * (frequencies / mode.imag) ** stage
        at, values = modes.towards(targets, at, values, np.ones(at.shape, dtype=bool))
    reached = np.abs(values.imag - frequencies) < _REACHED * frequencies
    return list(modes.space.decode(at[reached]))


def _twins(modes: _Modes) -> list[FloatArray]:
    """Chromosomes with one parameter that acts on the mode moved, the rest keeping the mode."""
    mode = modes.mode
    places = np.repeat(modes.acting[:_TURNED], len(_TURNS))
    at, _ = modes.here(len(places))
    turned = np.arange(at.shape[1]) == places[:, None]
    at[turned] += np.tile(_TURNS, len(places) // len(_TURNS)) * modes.width[places]
    moved, (lower, upper) = at[turned], modes.bounds
    inside = (moved >= lower[places]) & (moved <= upper[places])
    at, rest = at[inside], ~turned[inside]
    if not len(at):
        return []
    targets = np.full(len(at), mode)
    at, values = modes.towards(targets, at, modes.nearest(at, targets), rest, _STAGES * _ITERATIONS)
    return list(modes.space.decode(at[np.abs(values - mode) < _REACHED * abs(mode)]))


def _aliased(frequency: float, dt: float) -> FloatArray:
    """Aliases of a frequency [rad/s] at a sample time, nearest first."""
    rate = 2.0 * np.pi / dt
    count = int(_REACH * frequency / rate) + 2
    multiples = np.arange(-count, count + 1) * rate
    aliases = np.abs(np.concatenate([frequency + multiples, multiples - frequency]))
    apart = np.abs(aliases - frequency) > 1e-6 * frequency
    near = (aliases < _REACH * frequency) & (aliases > frequency / _REACH)
    aliases = np.unique(aliases[apart & near])
    nearest: FloatArray = aliases[np.argsort(np.abs(np.log(aliases / frequency)))]
    return nearest[:_MOST_ALIASES]


class _Modes:
    """Eigenvalues of the model linearised at the first record's start, by search coordinates.

    start: those of the minimum, (n_free,). mode: the eigenvalue there of largest imaginary
    part, or of largest size where nothing oscillates. acting: places of the parameters that act
    on it, the strongest first; differences of the rest are not taken.
    """

    def __init__(self, objective: Objective, chromosome: FloatArray) -> None:
        self.space, self.model = objective.space, objective.simulator.model
        record = objective.records[0]
        declared = record.initial_state(self.model)
        self.x, self.u = self.space.starts(chromosome[None], 0, declared)[0], record.inputs[0]
        self.start, self.width = self.space.encode(chromosome), self.space.width
        self.bounds = self.space.coded_bounds
        (values,) = self._eigenvalues(self.start[None])
        speeds = values.imag if values.imag.max() > 0.0 else np.abs(values)
        self._look_at(complex(values[np.argmax(speeds)]))

    def others(self, frequency: float) -> list[Self]:
        """The same of further modes above a frequency [rad/s]."""
        (values,) = self._eigenvalues(self.start[None])
        fast = [complex(v) for v in values if v.imag > frequency and v != self.mode]
        copies = [copy.copy(self) for _ in fast]
        for modes, mode in zip(copies, fast, strict=True):
            modes._look_at(mode)
        return copies

    def lags(self, chromosome: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rates (n,) at which states settle while the others rest, and their powers, (n, n_free).

        With the power k of a parameter, as k = -1 of an inductance, a rate goes by its k-th power.
        """
        (rates,) = self._rates(self.start[None])
        settling = rates > 0.0
        beside = np.where(np.eye(len(chromosome)) > 0.0, 1.0 + _DIFFERENCE, 1.0) * chromosome
        changes = self._rates(self.space.encode(beside))[:, settling] / rates[settling] - 1.0
        return rates[settling], changes.T / _DIFFERENCE

    def _rates(self, at: FloatArray) -> FloatArray:
        rates: FloatArray = -np.diagonal(self._matrices(at), axis1=1, axis2=2)
        return rates

    def _look_at(self, mode: complex) -> None:
        self.mode, self.acting = mode, np.arange(len(self.start))
        (slopes,) = self.slopes(*self.here(1))
        size = np.linalg.norm(slopes, axis=0)
        strongest = np.argsort(size)[::-1]
        self.acting = strongest[size[strongest] > _ACTING * size.max()]

    def here(self, count: int) -> tuple[FloatArray, ComplexArray]:
        """The minimum and its mode, repeated."""
        return np.repeat(self.start[None], count, axis=0), np.full(count, self.mode)

    def towards(
        self,
        targets: ComplexArray,
        at: FloatArray,
        values: ComplexArray,
        moving: BoolArray,
        iterations: int = _ITERATIONS,
    ) -> tuple[FloatArray, ComplexArray]:
        """Coordinates (n, n_free) and modes (n,) after the least Newton steps to the targets."""
        for _ in range(iterations):
            slopes = np.where(moving[:, None], self.slopes(at, values), 0.0)
            miss = np.stack([(targets - values).real, (targets - values).imag], axis=1)
            move = np.linalg.pinv(slopes, rcond=1e-9) @ miss[:, :, None]
            along = (slopes @ move)[:, :, 0]
            at = np.clip(at + move[:, :, 0] * self.width, *self.bounds)
            values = self.nearest(at, values + along[:, 0] + 1j * along[:, 1])
        return at, values

    def slopes(self, at: FloatArray, values: ComplexArray) -> FloatArray:
        """Slopes of the modes' real and imaginary parts by parts of the ranges, (n, 2, n_free)."""
        n, count = len(at), len(self.acting)
        back = at + _DIFFERENCE * self.width > self.bounds[1]
        shift = np.where(back, -_DIFFERENCE, _DIFFERENCE)
        beside = np.repeat(at[:, None], count, axis=1)
        beside[:, np.arange(count), self.acting] += (shift * self.width)[:, self.acting]
        moved = self.nearest(beside.reshape(n * count, -1), np.repeat(values, count))
        change = (moved.reshape(n, count) - values[:, None]) / shift[:, self.acting]
        slopes = np.zeros((n, 2, at.shape[1]))
        slopes[:, 0, self.acting], slopes[:, 1, self.acting] = change.real, change.imag
        return slopes

    def nearest(self, at: FloatArray, values: ComplexArray) -> ComplexArray:
        """The eigenvalue nearest to a value at each row of coordinates, (n,)."""
        eigenvalues = self._eigenvalues(at)
        chosen = np.argmin(np.abs(eigenvalues - values[:, None]), axis=1)
        nearest: ComplexArray = eigenvalues[np.arange(len(at)), chosen]
        return nearest

    def _eigenvalues(self, at: FloatArray) -> ComplexArray:
        eigenvalues = np.linalg.eigvals(self._matrices(at))
        return eigenvalues.astype(np.complex128)

    def _matrices(self, at: FloatArray) -> FloatArray:
        """Of how states change with states, (n, n_states, n_states), zero without a number."""
        vectors = self.space.full(self.space.decode(at))
        matrices = linear_models(self.model, self.x, self.u, vectors).A
        return np.where(np.isfinite(matrices), matrices, 0.0)
