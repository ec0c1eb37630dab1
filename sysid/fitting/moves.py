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
    at = space.encode(chromosome)
    inwards = np.where(at < space.coded_lower + 0.5 * space.width, _STEP, -_STEP) * space.width
    values = in_noise(space.decode(np.vstack([at, at + np.diag(inwards)])))
    return float(np.linalg.norm(directions(values[..., 1:] - values[..., :1]).T @ change.ravel()))


def directions(slopes: FloatArray) -> FloatArray:
    """Orthonormal changes of the residuals, (n, rank), that parameters make up for.

    slopes: (n_residuals, n_outputs, n_free), in parts of the noise. What a change has along these
    is by how many standard deviations it moves the combinations of parameters that make them.
    """
    columns = slopes.reshape(-1, slopes.shape[2])
    lengths = np.linalg.norm(columns, axis=0)
    felt = np.isfinite(lengths) & (lengths > 0.0)
    orthonormal: FloatArray = np.linalg.qr(columns[:, felt] / lengths[felt])[0]
    return orthonormal
