"""Parameters far from a minimum under which a linearised model answers its inputs alike.

A second-order lag does not say which of its time constants is the electrical one, and the two may
change places through parameters of quite different units. So parameters are sought anywhere in the
ranges whose frequency response, from every input to every output, is that of the minimum: by
Levenberg and Marquardt from many places at once, which costs no simulation. Where the response
leaves parameters tied, what is found is moved along its ties to where it is nearest to the minimum.
So it is seen whether it is merely elsewhere in the same valley, and found wherever in its valley
the minimum stands: to trade places parameters may have to leave where chance has put them.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from sysid.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from sysid.fitting.objective import Objective
from sysid.response.linearization import linear_models

_STARTS, _ITERATIONS = 32, 25
_FREQUENCIES = 12  # from a period of the record to near half the sample rate
_DAMPING, _EASED, _STIFFENED, _STUCK = 1e-2, 0.3, 10.0, 1e3
_DIFFERENCE = 1e-6
_ROUNDING = 1e-4  # of the largest, below which a column adds nothing to those before it
_FLOOR = 0.01  # of a response's peak, below which it hardly matters
_ALIKE = 0.05  # rms of the difference of two responses in parts of their size
_APART = 0.03  # of the ranges, within which two places are one
_MOST = 6
_SLIDES, _SLIDE = 25, 0.1  # along ties, and parts of the ranges of the first at most
_CORRECTIONS, _SAME = 3, 1e-3  # after each, and what may be missing then
_EAGER, _WARY = 1.5, 0.3  # by which slides grow that lead on, and shrink that do not
_ON_END = 1e-3  # parts of a range


def alike_responses(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes (n_free,) far from one, and from each other, that answer inputs as it does."""
    responses = _Responses(objective, chromosome)
    moving = responses.moving()
    if not len(moving):
        return []
    ends, misses = responses.beside(*responses.nearest(moving), moving)
    kept = [responses.start]
    for i in np.argsort(misses):
        new = all(np.abs((ends[i] - end) / responses.width).max() > _APART for end in kept)
        if misses[i] < _ALIKE and new and len(kept) <= _MOST:
            kept.append(ends[i])
    return [responses.space.decode(end) for end in kept[1:]]


def alike_directions(objective: Objective, chromosome: FloatArray) -> FloatArray:
    """Directions of the search coordinates, (k, n_free), along which inputs are answered alike.

    Those of parameters that each by itself changes the answers. Where an end of a range acts, such
    as an amplifier's, which the linearised model does not know, the outputs show them.
    """
    return _Responses(objective, chromosome).tied()


class _Responses:
    """Frequency responses of the model linearised at the first record's start.

    start: search coordinates of the minimum, (n_free,).
    """

    def __init__(self, objective: Objective, chromosome: FloatArray) -> None:
        self.space, self.model = objective.space, objective.simulator.model
        record = objective.records[0]
        declared = record.initial_state(self.model)
        self._x = self.space.starts(chromosome[None], 0, declared)[0]
        self._u = record.inputs[0]
        self._varied = np.ptp(record.inputs, axis=0) > 0.0
        longest = 2.0 * np.pi / (record.n_samples * record.dt)
        self._omega = np.geomspace(longest, 0.8 * np.pi / record.dt, _FREQUENCIES)
        self.start, self.width = self.space.encode(chromosome), self.space.width
        self._reference = self._answers(self._system(self.start[None]))[0][0]
        self._shape = self._reference.shape
        self._floor = _FLOOR * np.abs(self._reference).max(axis=0)

    def independent(self) -> IntArray:
        """Places of parameters that the response tells apart, the one that does most first."""
        if not self._reference.size:  # no input varies
            return np.empty(0, dtype=np.int64)
        slopes, chosen = self._own_slopes, list[int]()
        largest = np.linalg.norm(slopes, axis=0).max(initial=0.0)
        while len(chosen) < slopes.shape[1]:
            sizes = np.linalg.norm(slopes, axis=0)
            best = int(np.argmax(sizes))
            if not sizes[best] > _ROUNDING * largest:
                break
            chosen.append(best)
            direction = slopes[:, best] / sizes[best]
            slopes = slopes - np.outer(direction, direction @ slopes)
        return np.array(chosen, dtype=np.int64)

    def tied(self) -> FloatArray:
        """Directions that leave the response alone, (k, n_free), of parameters that move it."""
        free, count = self.independent(), len(self.start)
        if not len(free):
            return np.zeros((0, count))
        slopes, others = self._own_slopes, np.setdiff1d(self.moving(), free)
        directions = np.eye(count)[others]
        directions[:, free] = -np.linalg.lstsq(slopes[:, free], slopes[:, others])[0].T
        directions[np.abs(directions) < _ROUNDING] = 0.0
        return directions * self.width

    def moving(self) -> IntArray:
        """Places of parameters that move the response."""
        if not self._reference.size:  # no input varies
            return np.empty(0, dtype=np.int64)
        sizes = np.linalg.norm(self._own_slopes, axis=0)
        return np.flatnonzero(sizes > _ROUNDING * sizes.max(initial=0.0))

    @cached_property
    def _own_slopes(self) -> FloatArray:
        """Those at the start by all parameters, (m, n_free)."""
        slopes: FloatArray = self._slopes(self.start[None], np.arange(len(self.start)))[0]
        return slopes

    def beside(
        self, at: FloatArray, misses: FloatArray, moving: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Those that answer alike as far as ties lead towards the start, and what they miss."""
        alike = misses < _ALIKE
        at, misses = at[alike], misses[alike]
        reach, going = np.full(len(at), _SLIDE), np.arange(len(at))
        for _ in range(_SLIDES):
            if not len(going):
                break
            back, step = self._slide(at[going], moving)
            longest = np.maximum(np.abs(step).max(axis=1), _ON_END)
            step *= np.minimum(1.0, reach[going] / longest)[:, None]
            trial = self._moved(at[going], moving, step)
            for _ in range(_CORRECTIONS):  # a tie may be curved
                trial = self._moved(trial, moving, -_times(back, self._miss(trial)))
            missed = np.sqrt(np.mean(self._miss(trial) ** 2, axis=1))
            kept = missed < np.maximum(misses[going], _SAME)
            on = going[kept]
            at[on], misses[on] = trial[kept], missed[kept]
            reach[going] *= np.where(kept, _EAGER, _WARY)
            going = going[(longest > _ON_END) & (reach[going] > _ON_END)]
        return at, misses

    def _slide(self, at: FloatArray, moving: IntArray) -> tuple[FloatArray, FloatArray]:
        """Inverses of the slopes, (n, n_moving, m), and steps along ties, (n, n_moving).

        Towards the start, without parameters that would leave their ranges.
        """
        slopes, way = self._slopes(at, moving), ((self.start - at) / self.width)[:, moving]
        ends = np.stack(self.space.coded_bounds)[:, moving]
        on_end = np.abs(at[:, None, moving] - ends) < _ON_END * self.width[moving]
        square, inside = np.swapaxes(slopes, 1, 2) @ slopes, np.ones(way.shape, dtype=bool)
        for _ in range(_CORRECTIONS):
            both = inside[:, :, None] & inside[:, None]
            inverse = np.linalg.pinv(square * both, rcond=_ROUNDING**2, hermitian=True)
            step = inside * way - _times(inverse, _times(square * both, inside * way))
            inside &= ~(on_end[:, 0] & (step < 0.0)) & ~(on_end[:, 1] & (step > 0.0))
        return inverse @ np.swapaxes(slopes, 1, 2), step

    def _moved(self, at: FloatArray, places: IntArray, step: FloatArray) -> FloatArray:
        """Coordinates moved by steps (n, n_places) in parts of the ranges, within these."""
        moved = at.copy()
        moved[:, places] += step * self.width[places]
        return np.clip(moved, *self.space.coded_bounds)

    def nearest(self, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates (n, n_free) whose responses come nearest, and by how much they miss, (n,)."""
        rng = np.random.default_rng(0)
        lower, upper = self.space.coded_lower, self.space.coded_lower + self.width
        at = np.repeat(self.start[None], _STARTS, axis=0)
        at[:, free] = rng.uniform(lower[free], upper[free], (_STARTS, len(free)))
        miss, damping = self._miss(at), np.full(_STARTS, _DAMPING)
        slopes, going = self._slopes(at, free), np.arange(_STARTS)
        for _ in range(_ITERATIONS):
            slope, short = slopes[going], miss[going]
            square = np.swapaxes(slope, 1, 2) @ slope
            size = np.einsum("nii->ni", square)
            square += (damping[going, None] * size + 1e-12)[:, :, None] * np.eye(len(free))
            pull = -_times(np.swapaxes(slope, 1, 2), short)
            step = np.linalg.solve(square, pull[..., None])[..., 0].astype(np.float64)
            trial = self._moved(at[going], free, step)
            moved = self._miss(trial)
            better = np.sum(moved**2, axis=1) < np.sum(short**2, axis=1)
            on = going[better]
            at[on], miss[on] = trial[better], moved[better]
            damping[going] *= np.where(better, _EASED, _STIFFENED)
            arrived = np.mean(miss**2, axis=1) < _SAME**2
            going = np.flatnonzero(~arrived & (damping < _STUCK))
            on = np.intersect1d(on, going)
            if len(on):
                slopes[on] = self._slopes(at[on], free)
            if not len(going):
                break
        return at, np.sqrt(np.mean(miss**2, axis=1))

    def _slopes(self, at: FloatArray, places: IntArray) -> FloatArray:
        """Slopes of the differences by parts of the ranges of some parameters, (n, m, n_places)."""
        shape = len(at), len(places), -1
        beside = np.repeat(at[:, None], len(places), axis=1)
        beside[:, np.arange(len(places)), places] += _DIFFERENCE * self.width[places]
        system, moved = self._system(at), self._system(beside.reshape(-1, at.shape[1]))
        response, left, right = self._answers(system)
        # (n, f, q, 1, i, 1) times (n, f, 1, m, 1, j)
        factors = left[:, :, :, None, :, None] * np.swapaxes(right, 2, 3)[:, :, None, :, None, :]
        factors = factors.reshape(len(at), -1, system[0].size)
        with np.errstate(invalid="ignore", over="ignore"):  # where there is no finite system
            change = moved.reshape(shape) - system.reshape(len(at), 1, -1)
            moved_response = change @ np.swapaxes(factors, 1, 2)
        moved_response = response[:, None] + moved_response.reshape(*shape[:2], *self._shape)
        missed = self._missed(moved_response.reshape(-1, *self._shape)).reshape(shape)
        slopes: FloatArray = (missed - self._missed(response)[:, None]) / _DIFFERENCE
        return np.swapaxes(slopes, 1, 2)

    def _miss(self, at: FloatArray) -> FloatArray:
        """Differences from the minimum's response, in parts of the mean of both sizes, (n, m)."""
        return self._missed(self._answers(self._system(at))[0])

    def _missed(self, response: ComplexArray) -> FloatArray:
        """The same of responses (n, n_frequencies, n_outputs, n_varied)."""
        size = np.abs(response) + np.abs(self._reference) + self._floor
        with np.errstate(invalid="ignore"):
            miss = np.where(size > 0.0, 2.0 * (response - self._reference) / size, 0.0)
        miss = miss.reshape(len(response), -1)
        parts: FloatArray = np.concatenate([miss.real, miss.imag], axis=1)
        return np.where(np.isfinite(parts), parts, 2.0)

    def _system(self, at: FloatArray) -> FloatArray:
        """Matrices [[A, B], [C, D]] at coordinates (n, n_free), of the inputs that vary."""
        vectors = self.space.full(self.space.decode(at))
        a, b, c, d = linear_models(self.model, self._x, self._u, vectors)
        return np.block([[a, b[..., self._varied]], [c, d[..., self._varied]]])

    def _answers(self, system: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Responses (n, n_frequencies, n_outputs, n_varied), and what moves them.

        By a small change of the system a response changes by left @ change @ right.
        """
        n = len(self._x)
        (a, b), (c, d) = ((rows[:, None, :, :n], rows[:, None, :, n:])
                          for rows in (system[:, :n], system[:, n:]))  # fmt: skip
        whole: BoolArray = np.all(np.isfinite(a), axis=(2, 3), keepdims=True)
        s = 1j * self._omega[:, None, None]
        inverse = np.linalg.inv(s * np.eye(n) - np.where(whole, a, np.eye(n)))
        states, outputs = inverse @ b, c @ inverse
        response = np.where(whole, c @ states + d, np.nan)
        ones = (np.broadcast_to(np.eye(k), (*response.shape[:2], k, k)) for k in response.shape[2:])
        left = np.concatenate([outputs, next(ones)], axis=3)
        return response, left, np.concatenate([states, next(ones)], axis=2)


def _times(matrices: npt.NDArray[Any], vectors: FloatArray) -> FloatArray:
    """Each of the matrices (n, a, b) times its vector (n, b)."""
    product: FloatArray = (matrices @ vectors[..., None])[..., 0]
    return product
