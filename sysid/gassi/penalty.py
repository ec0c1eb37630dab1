"""Self-adaptive penalty for infeasible chromosomes, (4.13)-(4.20).

Source: Farmani & Wright, "Self-adaptive fitness formulation for constrained optimization",
IEEE Trans. Evolutionary Computation 7(5), 2003. Where the thesis's print differs from that
paper, the paper is followed: (4.15) uses max(0, |h| - delta), and the outer cases of (4.20)
compare the worst infeasible error with the best and scale by the population's highest error.
"""

import numpy as np

from sysid.arrays import FloatArray


def infeasibility(violations: FloatArray) -> FloatArray:
    """Infeasibility score (4.16) in [0, 1] of each chromosome, (n,).

    violations: (n, n_constraints), c_k of (4.15), each relative to its largest in the population.
    """
    if violations.shape[1] == 0:
        return np.zeros(len(violations))
    # An infinite violation is as bad as can be, and must not make the finite ones vanish.
    finite = np.isfinite(violations)
    worst = np.where(finite, violations, 0.0).max(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(finite, violations / worst, 1.0)
    # However small beside the largest, a violation never rounds to none.
    relative = np.where(violations > 0.0, np.maximum(relative, np.finfo(np.float64).tiny), 0.0)
    score: FloatArray = relative.mean(axis=1)
    return score


def find_indicators(errors: FloatArray, scores: FloatArray) -> tuple[int, int, int]:
    """Rows of the best, worst infeasible and highest-error chromosome, section 4.1.3.3.

    At least one error must be finite and one infeasibility score positive.
    """
    rows = np.flatnonzero(np.isfinite(errors))
    infeasible = rows[scores[rows] > 0.0]
    best = int(min(rows, key=lambda j: (scores[j], errors[j])))
    below = infeasible[errors[infeasible] < errors[best]]
    if len(below):
        # The most infeasible among those that look better than the best; ties: lowest error.
        worst = min(below, key=lambda j: (-scores[j], errors[j]))
    else:
        worst = min(infeasible, key=lambda j: (-scores[j], -errors[j]))
    return best, int(worst), int(rows[np.argmax(errors[rows])])


def penalise(errors: FloatArray, violations: FloatArray) -> FloatArray:
    """Errors with the penalties (4.18) and (4.19) added to infeasible chromosomes, (n,).

    Errors that are not finite (flagged simulations) pass through and take no part in the scale.
    """
    scores = infeasibility(violations)
    infeasible = np.isfinite(errors) & (scores > 0.0)
    if not infeasible.any():
        return errors.copy()
    indicators = list(find_indicators(errors, scores))
    (best, worst, highest), (least, most, _) = errors[indicators], scores[indicators]
    span = most - least
    # (4.17); with every chromosome equally infeasible there is nothing to grade. What is more
    # infeasible than the worst gets the full penalty, lest the exponential of (4.19) overflow.
    graded = (scores - least) / span if span > 0.0 else np.zeros_like(scores)
    graded = np.minimum(graded, 1.0)
    growth = (np.exp(2.0 * graded) - 1.0) / (np.exp(2.0) - 1.0)
    # gamma_penal of (4.20) brings the worst infeasible up to the highest error.
    reference, severity = max(best, worst), 0.0
    if worst != best and reference > 0.0:
        severity = (highest - reference) / reference
    penalised = errors.copy()
    first = errors[infeasible] + graded[infeasible] * max(best - worst, 0.0)  # (4.18)
    penalised[infeasible] = first + severity * np.abs(first) * growth[infeasible]  # (4.19)
    return penalised
