"""Parameters drawn from the covariance of an identification, as far as its ties reach."""

from collections.abc import Sequence

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.identifiability.cache import kept_identifiability
from sysid.identifiability.combination import Combination
from sysid.problem.model import ModelError, ProcessModel

_STEPS = 30  # of Newton's method, which takes about five
_CLOSE = 1e-9  # in parts of a combination's value


def plausible_parameters(
    model: ProcessModel, vector: FloatArray, names: Sequence[str], factor: FloatArray,
    n: int, seed: int,
) -> FloatArray:  # fmt: skip
    """Parameters drawn from a covariance with all its ties, (at most n, n_parameters).

    factor: F of the covariance F' F of the named ones, (m, len(names)): what acts only together
    moves together. Positive parameters move by factors. A covariance is
    straight, and in factors a tie such as J_m + J_b is not: what the equations let outputs
    determine is brought to where the covariance wants it. Draws that break the model's constraints,
    or that have no such place, are left out.

    >>> from sysid.examples import lag
    >>> drawn = plausible_parameters(lag(), np.array([3.0, 0.04]), ["gain"], np.eye(1), 50, 0)
    >>> drawn.shape, bool(np.all(drawn[:, 0] > 0.0)), bool(np.all(drawn[:, 1] == 0.04))
    ((50, 2), True, True)
    """
    rng = np.random.default_rng(seed)
    steps = np.zeros((n, len(vector)))
    places = [model.parameter_names.index(name) for name in names]
    steps[:, places] = rng.standard_normal((n, len(factor))) @ factor
    positive = np.array([p.scale == "log" for p in model.parameters])
    increments = np.where(positive, vector, 1.0)
    # What goes beyond all numbers is left out.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        steps = np.where(steps == 0.0, 0.0, steps / increments)
        moved = _moved(np.tile(vector, (n, 1)), steps, positive)
        for combinations in _curved(model, names):
            moved = _tied(model, vector, steps, moved, places, positive, combinations)
    kept = [
        draw
        for draw in moved[np.isfinite(moved).all(axis=1)]
        if all(c.function(tuple(draw)) <= 0.0 for c in model.constraints)
    ]
    return np.array(kept).reshape(-1, len(vector))


def _moved(vectors: FloatArray, steps: FloatArray, positive: BoolArray) -> FloatArray:
    """Vectors after steps in search coordinates, both (n, n_parameters)."""
    moved: FloatArray = np.where(positive, vectors * np.exp(steps), vectors + steps)
    return moved


def _curved(model: ProcessModel, names: Sequence[str]) -> list[list[Combination]]:
    """Combinations of each tied group that moves and has one that is no product."""
    groups: list[list[Combination]] = []
    try:
        tied = kept_identifiability(model).tied if len(names) else ()
    except (ModelError, ArithmeticError):  # equations that cannot be followed
        return groups
    for group in tied:
        usable = [c for c in group.combinations if set(c.names) <= set(model.parameter_names)]
        if any(len(c.terms) > 1 and set(c.names) & set(names) for c in usable):
            groups.append(usable)
    return groups


def _tied(
    model: ProcessModel, vector: FloatArray, steps: FloatArray, moved: FloatArray,
    places: Sequence[int], positive: BoolArray, combinations: Sequence[Combination],
) -> FloatArray:  # fmt: skip
    """Draws moved by as little as brings combinations to where straight steps lead them."""
    values, slopes = _evaluated(model, vector[None], positive, combinations)
    scale, rise = np.abs(values[0]), steps @ slopes[0].T
    # A sum of positive parameters stays positive, however far the covariance would take it.
    by_factors = scale * np.exp(rise / scale)
    wanted = np.where(_is_positive(model, combinations), by_factors, values + rise)
    free = np.zeros(len(vector), dtype=np.bool_)
    free[list(places)] = True
    for _ in range(_STEPS):
        values, slopes = _evaluated(model, moved, positive, combinations)
        left = (wanted - values) / scale
        if np.nanmax(np.abs(left), initial=0.0) < _CLOSE:
            break
        towards = np.where(free, slopes / scale[:, None], 0.0)
        usable = np.isfinite(towards).all(axis=(1, 2)) & np.isfinite(left).all(axis=1)
        change = np.zeros_like(moved)
        change[usable] = np.einsum("npk,nk->np", np.linalg.pinv(towards[usable]), left[usable])
        moved = _moved(moved, change, positive)
    moved[~(np.abs(left) < _CLOSE).all(axis=1)] = np.nan
    return moved


def _is_positive(model: ProcessModel, combinations: Sequence[Combination]) -> BoolArray:
    """Whether combinations are sums of products of positive parameters, (k,)."""
    positive = {p.name for p in model.parameters if p.scale == "log"}
    return np.array([
        positive.issuperset(c.names) and all(term.coefficient > 0.0 for term in c.terms)
        for c in combinations
    ])  # fmt: skip


def _evaluated(
    model: ProcessModel, vectors: FloatArray, positive: BoolArray,
    combinations: Sequence[Combination],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Combinations, (n, k), and their slopes by search coordinates, (n, k, n_parameters)."""
    columns = dict(zip(model.parameter_names, vectors.T, strict=True))
    values = np.stack([np.broadcast_to(c.value(columns), len(vectors)) for c in combinations], 1)
    slopes = np.zeros((*values.shape, vectors.shape[1]))
    for k, combination in enumerate(combinations):
        for name, slope in combination.gradient(columns).items():
            slopes[:, k, model.parameter_names.index(name)] = slope
    return values, slopes * np.where(positive, vectors, 1.0)[:, None]
