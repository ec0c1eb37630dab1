"""A minimum moved along its ties, from ends of ranges at which only they have left it.

Where the equations tie parameters, every point along the tie is a minimum, and chance decides at
which a descent ends. On an end of a range it would seem that the range were too narrow.
"""

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.space import SearchSpace
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import Ties, change, coded_gradient, named_values, ties

_HALVINGS = 4  # of a slide that a curved tie does not allow
_ITERATIONS = 15  # back onto a curved tie
_CORRECTIONS = 6  # back to the combinations that outputs show
_WORSE, _NO_BETTER = 1e-5, 1e-6  # shares of the error
_TINY = 1e-300


def slid(objective: Objective, chromosome: FloatArray) -> FloatArray | None:
    """The minimum (n_free,) of an error, slid inside; None where no end is left by that."""
    on_end = objective.space.on_bound(chromosome)
    if not on_end.any():
        return None
    tied = ties(sensitivity(objective, chromosome))
    on_end &= np.array(tied.bound, dtype=bool)
    return _slid(objective, chromosome, tied, on_end) if on_end.any() else None


def centred(objective: Objective, chromosome: FloatArray) -> FloatArray | None:
    """The minimum (n_free,) in the middle of its ties; None where nothing is tied.

    From there descents lead along other valleys without an end of a range that only ties reach.
    """
    tied = ties(sensitivity(objective, chromosome))
    nowhere = np.zeros(len(chromosome), dtype=bool)
    return _slid(objective, chromosome, tied, nowhere) if len(tied.directions) else None


def _slid(
    objective: Objective, chromosome: FloatArray, tied: Ties, on_end: BoolArray
) -> FloatArray | None:
    """The same, moved along ties, with none of some coordinates (n_free,) on an end any more."""
    space = objective.space
    at = space.encode(chromosome)
    slide = _to_the_middle(space, at, tied.directions)
    starts = [
        np.clip(_corrected(space, tied, at, at + 0.5**halving * slide), *space.coded_bounds)
        for halving in range(_HALVINGS)
    ]
    rows = space.decode(np.stack([at, *starts]))
    before, *errors = objective.evaluate(rows)[0].tolist()
    for k, error in enumerate(errors):
        start: FloatArray = rows[1 + k]
        if (space.on_bound(start) & on_end).any():
            continue
        if error <= (1.0 + _WORSE) * before:
            return start
        end = refine(objective, start, max_iterations=_ITERATIONS, tolerance=_NO_BETTER)
        if (space.on_bound(end.chromosome) & on_end).any():
            continue
        # Anew: descents end at integration steps of their own.
        if objective.evaluate(end.chromosome[None])[0][0] <= (1.0 + _WORSE) * before:
            return end.chromosome
    return None


def _corrected(space: SearchSpace, tied: Ties, at: FloatArray, moved: FloatArray) -> FloatArray:
    """Search coordinates (n_free,) moved along a tie, back where its combinations are as before."""
    if not tied.combinations:
        return moved
    target, onward = named_values(space, space.decode(at)), moved
    for _ in range(_CORRECTIONS):
        chromosome = space.decode(onward)
        here = named_values(space, chromosome)
        with np.errstate(over="ignore", invalid="ignore"):  # far out where they do not converge
            left = np.array([change(c, here, target) for c in tied.combinations])
            slopes = np.stack([coded_gradient(c, space, chromosome) for c in tied.combinations])
        if not (np.isfinite(left).all() and np.isfinite(slopes).all()):
            return moved
        size = np.maximum(np.linalg.norm(slopes, axis=1), _TINY)
        onward = onward + np.linalg.pinv(slopes / size[:, None]) @ (left / size)
    return onward if np.isfinite(onward).all() else moved


def _to_the_middle(space: SearchSpace, at: FloatArray, directions: FloatArray) -> FloatArray:
    """The move along directions (n, n_free) that comes nearest to the middle of the ranges."""
    left = (space.coded_lower - at) / space.width + 0.5
    lengths = np.linalg.lstsq((directions / space.width).T, left, rcond=None)[0]
    move: FloatArray = lengths @ directions
    return move
