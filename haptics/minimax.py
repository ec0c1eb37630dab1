"""The least largest magnitude of many responses, by convex steps in a trust region.

    minimise max_j |F_j(x)|  subject to  |G_k(x)| <= 1

F_j and G_k are complex vectors, smooth in x; the largest of their magnitudes is not, it has a kink
wherever two of them cross, which is where its minimum lies. A step d takes the responses as linear:

    minimise t + w s  over d, t, s >= 0:  |F + F' d| <= t,  |G + G' d| <= 1 + s,  |d| <= radius

It is convex, and solved by linear programs with tangents as cuts (Kelley, "The cutting-plane method
for solving convex programs", 1960). The step is taken if the largest, with what is beyond a bound,
falls by a part of what was promised; else the radius is halved (Madsen, "An algorithm for minimax
solution of overdetermined systems of non-linear equations", IMA Journal of Applied Mathematics 16,
1975).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from sysid.arrays import FloatArray

ComplexArray = NDArray[np.complex128]

_WEIGHT = 10.0  # of what is beyond a bound
_NEAR = 0.8  # of the largest, and of a bound: tangents of what is below are left out
_PART = 0.1  # of what is promised
_RADIUS, _LARGEST_RADIUS, _LEAST_RADIUS = 0.1, 0.5, 1e-3
_ENOUGH = 1e-3  # by which a step must lower the largest, in parts
_CUTS = 15
_CLOSE = 1e-3  # of a step's linear programs, in parts
_TINY = 1e-12


@dataclass(frozen=True)
class Responses:
    """F: (m, p), G: (n, q) at a point; slopes F_x: (m, p, n_x), G_x: (n, q, n_x) where wanted."""

    F: ComplexArray
    G: ComplexArray
    F_x: ComplexArray
    G_x: ComplexArray

    @property
    def merit(self) -> float:
        """The largest magnitude of F, and what of G is beyond 1, weighted."""
        beyond = np.linalg.norm(self.G, axis=1).max() - 1.0
        return float(np.linalg.norm(self.F, axis=1).max() + _WEIGHT * max(0.0, beyond))

    def after(self, d: FloatArray) -> "Responses":
        """Those of the linear responses after a step."""
        return Responses(self.F + self.F_x @ d, self.G + self.G_x @ d, self.F_x, self.G_x)


def least_largest(
    respond: Callable[[FloatArray, bool], Responses | None],
    x: FloatArray,
    farthest: float = math.inf,
    steps: int = 40,
) -> FloatArray:
    """From x to where the largest of F is least.

    respond: Responses at x, with slopes or without; None where there are none, at which it does not
    arrive. At the first x there are. farthest: from the first x, that any of its numbers goes.

    >>> def respond(x, slopes):
    ...     F = np.array([[x[0] + 1.0j], [x[0] - 2.0]])
    ...     return Responses(F, np.array([x / 9]), np.ones((2, 1, 1)), np.ones((1, 1, 1)) / 9)
    >>> round(float(least_largest(respond, np.array([5.0]))[0]), 2)
    0.75
    """
    radius, low, high = _RADIUS, x - farthest, x + farthest
    for _ in range(steps):
        here = respond(x, True)
        assert here is not None
        best = here.merit
        while True:
            step = convex_step(here, np.maximum(low - x, -radius), np.minimum(high - x, radius))
            promised, there = here.after(step).merit, respond(x + step, False)
            if there is not None and best - there.merit > _PART * (best - promised) > 0.0:
                break
            radius *= 0.5
            if radius < _LEAST_RADIUS:
                return x
        x, radius = x + step, min(1.5 * radius, _LARGEST_RADIUS)
        if best - there.merit < _ENOUGH * best:
            break
    return x


def convex_step(here: Responses, low: FloatArray, high: FloatArray) -> FloatArray:
    """The step between these, zero among them, after which the linear responses are least."""
    n = here.F_x.shape[-1]
    costs = np.append(np.zeros(n), [1.0, _WEIGHT])
    bounds = [*zip(low.tolist(), high.tolist(), strict=True), (None, None), (0.0, None)]
    best, d = np.zeros(n), np.zeros(n)
    rows, ends = np.zeros((0, n + 2)), np.zeros(0)
    for _ in range(_CUTS):
        there = here.after(d)
        if there.merit < here.after(best).merit:
            best = d
        for column, level, values, slopes in (
            (n, 0.0, there.F, here.F_x),
            (n + 1, 1.0, there.G, here.G_x),
        ):
            sizes = np.linalg.norm(values, axis=1)
            near = sizes > _NEAR * (level or sizes.max())
            tangents = np.real(np.einsum("mp,mpn->mn", values[near].conj(), slopes[near]))
            tangents /= np.maximum(sizes[near], _TINY)[:, None]
            cuts = np.zeros((len(tangents), n + 2))
            cuts[:, :n], cuts[:, column] = tangents, -1.0
            rows = np.vstack([rows, cuts])
            ends = np.append(ends, level - sizes[near] + tangents @ d)
        solution = linprog(costs, A_ub=rows, b_ub=ends, bounds=bounds)
        if solution.x is None or solution.fun is None:
            break
        if here.after(best).merit - solution.fun < _CLOSE * abs(solution.fun):
            break
        d = np.array(solution.x[:n])
    return best
