"""Parameters far from a minimum under which a linearised model answers its inputs alike.

A second-order lag does not say which of its time constants is the electrical one, and the two may
change places through parameters of quite different units. So parameters are sought anywhere in the
ranges whose frequency response, from every input to every output, is that of the minimum: by
Levenberg and Marquardt from many places at once, which costs no simulation. Parameters that the
response does not tell apart are left where they are, so that what is found is not merely elsewhere
in the same valley.
"""

from __future__ import annotations

import numpy as np

from sysid.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from sysid.fitting.objective import Objective
from sysid.response.linearization import linear_models

_STARTS, _ITERATIONS = 32, 25
_LEFT, _BY_THEN = 10, 6  # starts that go on, and iterations after which those are the nearest
_FREQUENCIES = 12  # from a period of the record to near half the sample rate
_DAMPING, _EASED, _STIFFENED = 1e-2, 0.3, 10.0
_DIFFERENCE = 1e-6
_ROUNDING = 1e-4  # of the largest, below which a column adds nothing to those before it
_FLOOR = 0.01  # of a response's peak, below which it hardly matters
_ALIKE = 0.05  # rms of the difference of two responses in parts of their size
_APART = 0.03  # of the ranges, within which two places are one
_MOST = 6


def alike_responses(objective: Objective, chromosome: FloatArray) -> list[FloatArray]:
    """Chromosomes (n_free,) far from one, and from each other, that answer inputs as it does."""
    responses = _Responses(objective, chromosome)
    free = responses.independent()
    if not len(free):
        return []
    ends, misses = responses.nearest(free)
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
        slopes = self._slopes(self.start[None], np.arange(len(self.start)))[0]
        chosen: list[int] = []
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
        slopes = self._slopes(self.start[None], np.arange(count))[0]
        sizes = np.linalg.norm(slopes, axis=0)
        moving = np.flatnonzero(sizes > _ROUNDING * sizes.max(initial=0.0))
        others = np.setdiff1d(moving, free)
        directions = np.eye(count)[others]
        directions[:, free] = -np.linalg.lstsq(slopes[:, free], slopes[:, others])[0].T
        directions[np.abs(directions) < _ROUNDING] = 0.0
        return directions * self.width

    def nearest(self, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates (n, n_free) whose responses come nearest, and by how much they miss, (n,)."""
        rng = np.random.default_rng(0)
        lower, upper = self.space.coded_lower, self.space.coded_lower + self.width
        at = np.repeat(self.start[None], _STARTS, axis=0)
        at[:, free] = rng.uniform(lower[free], upper[free], (_STARTS, len(free)))
        miss, damping = self._miss(at), np.full(_STARTS, _DAMPING)
        slopes = self._slopes(at, free)
        ends = tuple(bound[free] for bound in self.space.coded_bounds)
        for k in range(_ITERATIONS):
            if k == _BY_THEN:
                nearest = np.argsort(np.sum(miss**2, axis=1))[:_LEFT]
                at, miss, damping = at[nearest], miss[nearest], damping[nearest]
                slopes = slopes[nearest]
            square = np.swapaxes(slopes, 1, 2) @ slopes
            size = np.einsum("nii->ni", square)
            square += (damping[:, None] * size + 1e-12)[:, :, None] * np.eye(len(free))
            step = np.linalg.solve(square, -np.swapaxes(slopes, 1, 2) @ miss[:, :, None])[..., 0]
            trial = at.copy()
            trial[:, free] = np.clip(at[:, free] + step * self.width[free], *ends)
            moved = self._miss(trial)
            better = np.sum(moved**2, axis=1) < np.sum(miss**2, axis=1)
            at, miss = np.where(better[:, None], trial, at), np.where(better[:, None], moved, miss)
            damping *= np.where(better, _EASED, _STIFFENED)
            if better.any():
                slopes[better] = self._slopes(at[better], free)
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
