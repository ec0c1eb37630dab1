"""How far a change of the residuals moves what is estimated."""

from collections.abc import Callable

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.space import SearchSpace

_STEP = 1e-3  # of search coordinates, in parts of their ranges: tells slopes in spite of kinks


def moved_by(
    change: FloatArray,
    in_noise: Callable[[FloatArray], FloatArray],
    space: SearchSpace,
    chromosome: FloatArray,
) -> float:
    """Standard deviations that a change moves any quantity by, at most.

    change: (n_residuals, n_outputs), in parts of the noise. in_noise: residuals of chromosomes
    (n, n_free) in these parts, (n_residuals, n_outputs, n). chromosome: (n_free,), about which.
    """
    lower, upper = space.coded_bounds
    at = space.encode(chromosome)
    inwards = np.where(at < 0.5 * (lower + upper), _STEP, -_STEP) * (upper - lower)
    values = in_noise(space.decode(np.vstack([at, at + np.diag(inwards)])))
    slopes = (values[..., 1:] - values[..., :1]).reshape(-1, len(chromosome))
    lengths = np.linalg.norm(slopes, axis=0)
    felt = np.isfinite(lengths) & (lengths > 0.0)
    directions, _ = np.linalg.qr(slopes[:, felt] / lengths[felt])
    return float(np.linalg.norm(directions.T @ change.ravel()))
