"""The quadratic that bounds the error around a point, and the damped steps down it.

With r_j the outputs' errors at the point, f the floor below which they are smoothed and
m_j = max(r_j, f), the smoothed error E_f of a step d is bounded from above by a sum of squares
that touches it at d = 0 (majorisation: Hunter & Lange, "A tutorial on MM algorithms", The American
Statistician 58, 2004):

    E_f(d) <= sum_j w_j (r_j(d)^2 / m_j + m_j) / 2

Its fixed point is the minimum of the mean RMSE rather than of the plain sum of squares. With
e_j(d) = e_j + J_j d, the columns of J_j being differences of simulations (Gauss-Newton):

    E_f(d) ~ E_f + g'd + d'H d / 2
    H = sum_j c_j J_j' J_j        g = sum_j c_j J_j' e_j        c_j = w_j / (n_j m_j)

A step damped by lambda solves (Marquardt, "An algorithm for least-squares estimation of nonlinear
parameters", Journal of the SIAM 11, 1963)

    (H + lambda D) d = -g        D = diag H

between the bounds of the ranges; one that would cross constraints slides along them. What the
quadratic promises to gain is the share -(g'd + d'H d / 2) / E_f. Steps and slopes are in parts of
the ranges.

Between parameters that are nearly tied diag H is that of a valley's walls, and damping by it turns
a step away from the valley before it shortens it. So steps with the same damping of all coordinates
are tried as well, as Levenberg damped them, which are short along the valley and whole across it; a
part of the undamped step; and, where nothing gains what is promised, lengths of that which are bent
with the valley. With exact slopes all of these are led back into the valley instead: they tell a
floor from walls that are a hundred million times as steep, which differences do not.

H = R'R. With exact slopes it is never summed up, for then only a hundred million remain of what 53
bits can tell: R is of orthogonal factors of the J_j, weighed and one above the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.fitting.objective import Linearisation, Objective, Responses, smoothed
from sysid.fitting.slopes import Slopes, triangle_of
from sysid.problem.space import SearchSpace

# The values of lambda that are tried, in parts of the middle one.
_FACTORS = 5.0 ** np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
FIRST_DAMPING = 1e-2
_LEAST_DAMPING, _LEAST_BY_TANGENTS, _MOST_DAMPING = 1e-14, 1e-18, 1e6
# The same damping of all coordinates, in parts of the largest curvature.
_EQUAL = 10.0 ** np.array([-5.0, -7.0, -9.0, -11.0])
_HOLDING_ROUNDS = 4  # in which the coordinates that hit a bound are held there
_PART = 0.1  # of the undamped step, which tells how the valley bends
_LENGTHS = np.array([1.0, 0.5, 0.25, 0.1, 0.03])  # of the undamped step
# Simulations of candidates that an iteration takes, straight and bent ones.
CANDIDATES = 2 * len(_FACTORS) + len(_EQUAL) + 1 + len(_LENGTHS)
_RESTORING = 1e-10  # as of ``_EQUAL``, of steps back into a valley: they are not to go along it
_PERTURBATION = 1e-6  # of constraints, in parts of the ranges
# A slide ends this far inside, in parts of the constraint's slope: on it rounding would decide.
_MARGIN = 1e-6
# A step that ends where a limit is violated is shortened so often, each time to this part.
_SHORTENINGS, _SHORTER = 6, 0.4


@dataclass(frozen=True)
class Quadratic:
    """R, (n_free, n_free), q, (n_free,), and the smoothed error E_f at the point.

    factors: c, (n_outputs,). floor: the least lambda. lengths: parts of the undamped step that are
    tried.
    """

    root: FloatArray
    right: FloatArray
    error: float
    factors: FloatArray
    floor: float
    lengths: FloatArray

    @classmethod
    def at(cls, objective: Objective, around: Linearisation, floor: float) -> Self:
        """At a point, by the residuals and slopes there; floor: of the outputs' errors."""
        rms, weights = around.rms, objective.weights
        c = weights / (np.maximum(rms, floor) * np.maximum(objective.counts, 1))
        exact, slopes = objective.exact_slopes, around.slopes
        root, right = (slopes.triangle if exact else slopes.root)(around.residual, c)
        error = float(smoothed(rms, floor) @ weights)
        least, lengths = _LEAST_DAMPING, np.array([_PART])
        if exact:
            least, lengths = _LEAST_BY_TANGENTS, _LENGTHS
        return cls(root, right, error, c, least, lengths)

    @property
    def hessian(self) -> FloatArray:
        """H, (n_free, n_free)."""
        return self.root.T @ self.root

    def push(self, slopes: Slopes, errors: Callable[[int], FloatArray], count: int) -> FloatArray:
        """sum_j c_j J_j' e_j of so many points, (count, n_free).

        errors: (count, n_residuals), e of an output by its place.
        """
        pushes = np.zeros((count, len(self.right)))
        with np.errstate(over="ignore", invalid="ignore"):
            for j in np.flatnonzero(self.factors > 0.0).tolist():
                pushes += self.factors[j] * slopes.pushes(errors(j), j)
        return pushes

    @property
    def leads_somewhere(self) -> bool:
        """Whether it is finite and not flat; slopes at the edge of stability may overflow."""
        finite = np.isfinite(self.root).all() and np.isfinite(self.right).all()
        return bool(finite and self.root.any())


@dataclass(frozen=True)
class Candidates:
    """Coordinates that may follow a point, (n, n_free), and the middle lambda then, (n,).

    promise: share of the error that the quadratic's own minimum would take away. undamped: whether
    the last one is part of the way to that minimum. short: how many, from the first, are of steps
    that lambda shortens.
    """

    coordinates: FloatArray
    damping: FloatArray
    promise: float
    undamped: bool = False
    short: int = 0

    @property
    def shortened(self) -> Candidates:
        """Those of steps that lambda shortens."""
        n = self.short
        return Candidates(self.coordinates[:n], self.damping[:n], self.promise, short=n)

    def joined(self, more: Candidates) -> Candidates:
        """These and more of the same point, of which none is told apart any more."""
        coordinates = np.concatenate([self.coordinates, more.coordinates])
        damping = np.concatenate([self.damping, more.damping])
        return replace(self, coordinates=coordinates, damping=damping, undamped=False)


def candidates(
    space: SearchSpace,
    at: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    damping: FloatArray,
    quadratics: Sequence[Quadratic],
) -> list[Candidates]:
    """Candidates of several points, between bounds and within the constraints.

    at: (m, n_free), search coordinates of the points; bounds: two of (m, n_free); damping: (m,),
    the middle lambda of each.
    """
    if not quadratics:
        return []
    root = np.stack([quadratic.root for quadratic in quadratics])
    right = np.stack([quadratic.right for quadratic in quadratics])
    floor = np.array([quadratic.floor for quadratic in quadratics])
    lower, upper = (ends[:, None] for ends in bounds)
    at, width = at[:, None], space.width
    low, high = (lower - at) / width, (upper - at) / width
    # The last one is for the promise.
    lambdas = damping[:, None] * np.append(_FACTORS, 0.0)
    lambdas = np.clip(lambdas, floor[:, None], _MOST_DAMPING)
    diagonal = np.sum(root**2, axis=1)
    scale = np.maximum(diagonal, 1e-12 * diagonal.max(axis=1, keepdims=True))
    equal = diagonal.max(axis=1)[:, None, None] * _EQUAL[:, None] * np.ones(diagonal.shape[1])
    added = lambdas[:, :, None] * scale[:, None]
    added = np.concatenate([added[:, :-1], equal, added[:, -1:]], axis=1)
    steps = _damped(root, right, added, low, high)
    beyond = infeasible(space, at + steps * width)
    if beyond.any() and space.model.constraints:
        for k in np.flatnonzero(beyond.any(axis=1)).tolist():
            limits = Constraints.at(space, at[k, 0], width)
            for j in np.flatnonzero(beyond[k]).tolist():
                curvature = quadratics[k].hessian + np.diag(added[k, j])
                steps[k, j] = limits.slid(steps[k, j], curvature, low[k, 0], high[k, 0])
    for _ in range(_SHORTENINGS):
        if not beyond.any():
            break
        beyond[beyond] = infeasible(space, (at + steps * width)[beyond])
        steps[beyond] *= _SHORTER
    coordinates = np.clip(at + steps * width, lower, upper)
    changes = steps @ np.swapaxes(root, 1, 2)
    gained = -np.sum(changes * (right[:, None] + 0.5 * changes), axis=2)
    promises = gained / np.array([quadratic.error for quadratic in quadratics])[:, None]
    kept = (~beyond & (promises > 0.0))[:, :-1]
    n_short = len(_FACTORS)
    lighter = np.repeat(damping[:, None], added.shape[1], axis=1)  # of steps damped alike, too
    lighter[:, :n_short] = lambdas[:, :-1]
    lighter = np.clip(lighter / np.sqrt(_FACTORS[-1]), floor[:, None], _MOST_DAMPING)
    undamped = ~beyond[:, -1] & (promises[:, -1] > 0.0) & kept.any(axis=1)
    short = kept[:, :n_short].sum(axis=1).tolist()
    offers = []
    for k, promise in enumerate(promises.max(axis=1).tolist()):
        rows, dampings = coordinates[k, :-1][kept[k]], lighter[k, :-1][kept[k]]
        if undamped[k]:  # lambda stays as it is
            lengths = quadratics[k].lengths
            along = at[k] + lengths[:, None] * steps[k, -1] * width
            rows = np.concatenate([rows, np.clip(along, lower[k], upper[k])])
            dampings = np.concatenate([dampings, np.full(len(lengths), damping[k])])
        offers.append(Candidates(rows, dampings, promise, bool(undamped[k]), short[k]))
    return offers


def bent(
    objective: Objective,
    at: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    quadratic: Quadratic,
    offer: Candidates,
    around: Linearisation,
    ends: Responses,
) -> Candidates:
    """Candidates from a point (n_free,) bent by what the errors at their ends are not linear by.

    Of those that lambda shortens and of the undamped step. around: the point; ends: of the
    candidates. With s_j = e_j(d) - e_j - J_j d a step d goes on by the solution of
    (H + lambda D) b = -sum_j c_j J_j' s_j (Transtrum & Sethna, "Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization", arXiv:1201.5885, by a
    finite step). In a narrow valley that bends, straight steps are short. Along the undamped step s
    grows with the square of the length: t d goes on by t^2 b.
    """
    chosen = [
        *range(offer.short),
        *range(len(offer.coordinates) - offer.undamped, len(offer.coordinates)),
    ]
    offer = replace(offer, coordinates=offer.coordinates[chosen], damping=offer.damping[chosen])
    space, (lower, upper) = objective.space, bounds
    steps = (offer.coordinates - at) / space.width

    def surplus(j: int) -> FloatArray:
        foretold = around.residual[:, j] + around.slopes.along(steps, j)
        return ends.values[:, j, chosen].T - foretold

    diagonal = np.sum(quadratic.root**2, axis=0)
    scale = np.maximum(diagonal, 1e-12 * diagonal.max())
    added = np.sqrt(_FACTORS[-1]) * offer.damping[:, None] * scale
    if offer.undamped:
        added[-1] = quadratic.floor * scale
    free = (offer.coordinates > lower) & (offer.coordinates < upper)
    moves = _led(quadratic, added, free, around.slopes, surplus)
    coordinates, damping = offer.coordinates + moves * space.width, offer.damping
    if offer.undamped:
        t = _LENGTHS[:, None] / _PART
        lengths = at + t * (offer.coordinates[-1] - at) + t**2 * moves[-1] * space.width
        coordinates = np.concatenate([coordinates[:-1], lengths])
        damping = np.append(damping[:-1], np.full(len(lengths), damping[-1]))
    return _kept(offer, objective.space, np.clip(coordinates, lower, upper), damping)


def restored(
    objective: Objective,
    at: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    quadratic: Quadratic,
    offer: Candidates,
    around: Linearisation,
    ends: Responses,
) -> Candidates:
    """Candidates from a point (n_free,) that have left a narrow valley, back in it; as ``bent``.

    Of all of them. The valley bends as the square of a step along it, and its walls may be a
    hundred million times as steep as its floor. From the errors e(d) at the end of a step d, and
    the slopes J where it began, b = -(H + mu I)^-1 sum_j c_j J_j' e_j(d) leads back: the walls
    hardly turn within a step, and mu keeps b from going along the valley.
    """
    space, (lower, upper) = objective.space, bounds
    free = (offer.coordinates > lower) & (offer.coordinates < upper)
    mu = _RESTORING * np.sum(quadratic.root**2, axis=0).max() * np.ones(free.shape)
    moves = _led(quadratic, mu, free, around.slopes, lambda j: ends.values[:, j].T)
    coordinates = np.clip(offer.coordinates + moves * space.width, lower, upper)
    return _kept(offer, space, coordinates, offer.damping)


def _led(
    quadratic: Quadratic,
    added: FloatArray,
    free: BoolArray,
    slopes: Slopes,
    errors: Callable[[int], FloatArray],
) -> FloatArray:
    """Steps b of free coordinates with (H + added) b = -sum_j c_j J_j' e_j, (n, n_free) each.

    errors: as of ``Quadratic.push``.
    """
    pushes = quadratic.push(slopes, errors, len(free))
    triangles = _triangles(quadratic.root[None], added, ~free)
    halves = _solved(np.swapaxes(triangles, 1, 2), np.where(free, -pushes, 0.0))
    return _solved(triangles, halves)


def _kept(
    offer: Candidates, space: SearchSpace, coordinates: FloatArray, damping: FloatArray
) -> Candidates:
    """Of coordinates (n, n_free) those that may be simulated, in the place of an offer's."""
    kept = np.flatnonzero(np.isfinite(coordinates).all(axis=1))
    kept = kept[~infeasible(space, coordinates[kept])]
    return replace(offer, coordinates=coordinates[kept], damping=damping[kept], undamped=False)


def heavier(damping: float) -> float:
    """The next middle lambda after no gain around the given one."""
    return float(np.clip(damping * _FACTORS[-1] / _FACTORS[0], _LEAST_DAMPING, _MOST_DAMPING))


def infeasible(space: SearchSpace, coordinates: FloatArray) -> BoolArray:
    """Which coordinates (..., n_free) violate a constraint or a physical limit, (...)."""
    violations = space.violations(space.decode(coordinates.reshape(-1, coordinates.shape[-1])))
    infeasible: BoolArray = np.any(violations > 0.0, axis=1).reshape(coordinates.shape[:-1])
    return infeasible


def _damped(
    root: FloatArray, right: FloatArray, added: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Minima of damped quadratics between bounds on the step, by holding what hits them.

    root: (m, n_free, n_free), right: (m, n_free); added: (m, n, n_free), lambda D of n steps of
    each; low, high: (m, 1, n_free).
    """
    across = np.swapaxes(root, 1, 2)
    down = -(across @ right[..., None])[..., 0][:, None]
    # A direction held by a bound and pushed against it would only shorten the step.
    pushed = ((low >= 0.0) & (down < 0.0)) | ((high <= 0.0) & (down > 0.0))
    held = np.repeat(pushed, added.shape[1], axis=1)
    steps = np.zeros(added.shape)
    live = np.arange(len(root))
    for _ in range(_HOLDING_ROUNDS):
        if not len(live):
            break
        stay = held[live]
        fixed = np.where(stay, steps[live], 0.0)
        wanted = -right[live, None] - fixed @ across[live]
        triangles = _triangles(root[live, None], added[live], stay, wanted)
        solutions = _solved(triangles[..., :-1, :-1], triangles[..., :-1, -1])
        solutions = np.where(stay, fixed, solutions)
        out = ~stay & ((solutions < low[live]) | (solutions > high[live]))
        steps[live] = np.clip(solutions, low[live], high[live])
        held[live] |= out
        live = live[out.any(axis=(1, 2))]
    return np.where(np.isfinite(steps), steps, 0.0)


def _triangles(
    root: FloatArray, added: FloatArray, stay: BoolArray, wanted: FloatArray | None = None
) -> FloatArray:
    """Triangles T with T'T = R'R + added, (..., n_free, n_free), of coordinates that do not stay.

    root: (..., n_free, n_free); added, stay: (..., n_free). wanted: (..., n_free), a column more,
    from which follows the step d whose R d is nearest to it.
    """
    n = added.shape[-1]
    columns = n if wanted is None else n + 1
    rows, places = np.zeros((*added.shape[:-1], 2 * n, columns)), np.arange(n)
    rows[..., :n, :n] = np.where(stay[..., None, :], 0.0, root)
    rows[..., n + places, places] = np.where(stay, 1.0, np.sqrt(added))
    if wanted is not None:
        rows[..., :n, n] = wanted
    return triangle_of(rows)


def _solved(systems: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions (m, n, n_free) of linear systems, NaN for all n where one of them is singular."""
    try:
        solutions: FloatArray = np.linalg.solve(systems, right[..., None])[..., 0].astype(float)
        return solutions
    except np.linalg.LinAlgError:
        if len(systems) == 1:
            return np.full(right.shape, np.nan)
    pairs = zip(systems[:, None], right[:, None], strict=True)
    return np.concatenate([_solved(system, side) for system, side in pairs])


@dataclass(frozen=True)
class Constraints:
    """Linearised constraints g <= 0: value g at a point, (n,), and slope by moves, (n, n_free)."""

    value: FloatArray
    slope: FloatArray

    @classmethod
    def at(cls, space: SearchSpace, coded: FloatArray, width: FloatArray) -> Self:
        """At search coordinates (n_free,), by central differences; moves in units of ``width``."""
        shift = _PERTURBATION * np.diag(width)
        points = space.decode(np.concatenate([coded[None], coded + shift, coded - shift]))
        values, n = space.constraint_values(points), len(coded)
        return cls(values[0], (values[1 : n + 1] - values[n + 1 :]).T / (2.0 * _PERTURBATION))

    def among(self, free: IntArray) -> Self:
        """Constraints that moves of the free parameters alone can reach."""
        slope = self.slope[:, free]
        reached = np.isfinite(slope).all(axis=1) & np.any(slope != 0.0, axis=1)
        return type(self)(self.value[reached], slope[reached])

    def slid(
        self, step: FloatArray, curvature: FloatArray, low: FloatArray, high: FloatArray
    ) -> FloatArray:
        """A step that slides along the constraints it would cross, bounds kept."""
        between = (step > low) & (step < high)
        free, held = np.flatnonzero(between), ~between
        rest = replace(self, value=self.value + self.slope[:, held] @ step[held])
        inverse: FloatArray = np.linalg.inv(curvature[np.ix_(free, free)]).astype(np.float64)
        slid = step.copy()
        slid[free] = rest.among(free).nearest(step[free], inverse)
        return np.clip(slid, low, high)

    def nearest(self, move: FloatArray, inverse: FloatArray) -> FloatArray:
        """Minimum within the constraints of a quadratic whose free minimum is a move (n_free,).

        inverse: of its Hessian, (n_free, n_free). Dual active-set method (Nocedal & Wright,
        "Numerical optimization", section 16.5): the most violated constraint joins, those that
        would pull leave.
        """
        size = np.linalg.norm(self.slope, axis=1)
        limit = -self.value - _MARGIN * size
        active: list[int] = []
        moved = move
        for _ in range(3 * len(limit)):
            over = (self.slope @ moved - limit) / size
            over[active] = -np.inf
            worst = int(np.argmax(over))
            if over[worst] <= 0.0:
                break
            active.append(worst)
            while active:
                rows = self.slope[active]
                system, excess = rows @ inverse @ rows.T, rows @ move - limit[active]
                push = np.linalg.lstsq(system, excess, rcond=1e-12)[0]
                if push.min() >= 0.0:
                    break
                active.pop(int(np.argmin(push)))
            moved = move - inverse @ self.slope[active].T @ push if active else move
        return moved
