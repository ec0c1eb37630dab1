"""A minimum moved along its ties, from ends of ranges at which only they have left it.

Where the equations tie parameters, every point along the tie is a minimum, and chance decides at
which a descent ends. On an end of a range it would seem that the range were too narrow.
"""

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import Refinement, refine
from sysid.problem.space import SearchSpace
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import Ties, ties

_HALVINGS = 4  # of a slide that a curved tie does not allow
_ITERATIONS = 15  # back onto a curved tie
_WORSE, _NO_BETTER = 1e-5, 1e-6  # shares of the error


def slid(objective: Objective, chromosome: FloatArray) -> Refinement | None:
    """The minimum (n_free,) of an error, slid inside; None where no end is left by that."""
    on_end = objective.space.on_bound(chromosome)
    if not on_end.any():
        return None
    tied = ties(sensitivity(objective, chromosome))
    on_end &= np.array(tied.bound, dtype=bool)
    return _slid(objective, chromosome, tied, on_end) if on_end.any() else None


def centred(objective: Objective, chromosome: FloatArray) -> Refinement | None:
    """The minimum (n_free,) in the middle of its ties; None where nothing is tied.

    From there descents lead along other valleys without an end of a range that only ties reach.
    """
    tied = ties(sensitivity(objective, chromosome))
    nowhere = np.zeros(len(chromosome), dtype=bool)
    return _slid(objective, chromosome, tied, nowhere) if len(tied.directions) else None


def _slid(
    objective: Objective, chromosome: FloatArray, tied: Ties, on_end: BoolArray
) -> Refinement | None:
    """The same, moved along ties, with none of some coordinates (n_free,) on an end any more."""
    space = objective.space
    at = space.encode(chromosome)
    slide = _to_the_middle(space, at, tied.directions)
    for halving in range(_HALVINGS):
        start = np.clip(at + 0.5**halving * slide, *space.coded_bounds)
        end = refine(
            objective, space.decode(start), max_iterations=_ITERATIONS, tolerance=_NO_BETTER
        )
        if (space.on_bound(end.chromosome) & on_end).any():
            continue
        # Both anew: descents end at integration steps of their own.
        before, after = objective.evaluate(np.stack([chromosome, end.chromosome]))[0]
        if after <= (1.0 + _WORSE) * before:
            return end
    return None


def _to_the_middle(space: SearchSpace, at: FloatArray, directions: FloatArray) -> FloatArray:
    """The move along directions (n, n_free) that comes nearest to the middle of the ranges."""
    left = (space.coded_lower - at) / space.width + 0.5
    lengths = np.linalg.lstsq((directions / space.width).T, left, rcond=None)[0]
    move: FloatArray = lengths @ directions
    return move
