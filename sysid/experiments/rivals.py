"""Rival structures, refitted to what a run would log if another structure were right.

Structure i says that a run logs y_i. Of a rival j at coordinates x let e = y_i - y_j(x) be what is
left, S its tangents, and W the inverse variances of the samples, noise of measured inputs included.
All that matters of a run, as long as x moves little, is

    M = [S e]' W [S e]

which adds over runs as information does. What the best x leaves is the Schur complement of the last
entry, e' W e - e' W S (S' W S)^-1 S' W e: the T-criterion (Atkinson and Fedorov, "The design of
experiments for discriminating between two rival models", Biometrika 62, 1975).

It is the noncentrality of a test along W e where the noise is white. Noise of an input moves the
outputs by G n, which is not: the test's statistic then scatters by the variance e' W V W e, V = R +
G G', and its noncentrality is (e' W e)^2 / e' W V W e. A run's M is scaled to that.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinvh

from sysid.arrays import BoolArray, FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.experiments.information import Informant, without_starts
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

_ITERATIONS = 100  # of a refit
_DAMPING = 1e-2  # with which one begins, in parts of the curvature
_LIGHTEST, _HEAVIEST = 1e-6, 1e4
_DAMPINGS = 10.0 ** np.arange(-3.0, 5.0)  # that are tried at once, as many as there are lanes
# What an iteration is to lower the rest by: a share of it, and not more than what decides nothing.
_ENOUGH, _LITTLE = 0.01, 0.5
_PATIENCE = 3  # iterations in a row that lower it by less
_NOTHING = 0.01  # what is left of which nothing need be fitted


@dataclass(frozen=True)
class Hypothesis:
    """A structure: what simulates it, and the values that are likeliest if it is right.

    values: (n_free,). ridge: (n_free, n_free), information that its ranges are, which damps moves.
    """

    name: str
    simulator: BatchSimulator
    informant: Informant
    space: SearchSpace
    values: FloatArray
    ridge: FloatArray


def nested(rival: Hypothesis, names: Sequence[str], values: FloatArray) -> FloatArray:
    """A rival's chromosome (n_free,) at another structure's values of what both have.

    names, values: (n,), of the other's parameters. What the rival has beside is as little as may
    be: a structure that holds the other as a special case is next to it there.
    """
    space, shared = rival.space, dict(zip(names, values, strict=True))
    wanted = [shared.get(name, 0.0) for name in space.names]
    chromosome: FloatArray = np.clip(wanted, space.lower, space.upper)
    return chromosome if space.feasible(chromosome) else rival.values


@dataclass(frozen=True)
class Answer:
    """What a run would log if a structure were right.

    outputs: (n_samples, n_outputs). weights: inverse variances of the samples' errors, 0 for an
    output that does not count; white: share of the variances that is not from the inputs' noise;
    pushes: (n_samples, n_outputs, n_draws), what draws of that noise do. n_steps: of the
    integration, for all structures.
    """

    record: Dataset
    outputs: FloatArray
    weights: FloatArray
    white: FloatArray
    pushes: FloatArray
    n_steps: int

    @property
    def finite(self) -> bool:
        """Whether its simulation did not fail."""
        parts = (self.outputs, self.weights, self.pushes)
        return all(bool(np.isfinite(part).all()) for part in parts)


def answer(structure: Hypothesis, record: Dataset, n_steps: int, counted: BoolArray) -> Answer:
    """What a structure says that a run of a record's inputs logs.

    counted: (n_outputs,), whether an output does.
    """
    vector, values = structure.space.full(structure.values), structure.values
    outputs = structure.simulator.trajectories(vector[None], record, n_steps)[0]
    variances = structure.informant.variances(record, outputs[None])[0]
    pushes = structure.informant.pushes(record, values)
    moved = np.sum(pushes**2, axis=-1) / max(pushes.shape[-1], 1)
    with np.errstate(invalid="ignore"):
        white = np.where(counted, variances / (variances + moved), 0.0)
    weights = np.where(counted, 1.0 / (variances + moved), 0.0)
    return Answer(record, outputs, weights, white, pushes.astype(np.float32), n_steps)


@dataclass(frozen=True)
class Contrast:
    """What a rival leaves of an answer, and how it would move.

    errors: (n_samples * n_outputs,), slopes: (..., n_free + n_unknown). joint: (n_free + 1,
    n_free + 1), the M above, unknown starts eliminated; infinite where a simulation failed.
    """

    answer: Answer
    errors: FloatArray
    slopes: FloatArray
    joint: FloatArray

    def efficiency(self, ridge: FloatArray | None = None) -> float:
        """Noncentrality over what is left: 1 where all noise is white.

        ridge: refits first the run alone, with that damping; None: no coordinate moves.
        """
        if not self.answer.pushes.shape[-1] or not np.isfinite(self.joint).all():
            return 1.0
        n_free, weights = len(self.joint) - 1, self.answer.weights.reshape(-1)
        slopes = self.slopes[:, n_free:] if ridge is None else self.slopes
        left = self.errors
        if slopes.shape[1]:
            curvature = slopes.T @ (weights[:, None] * slopes)
            if ridge is not None:
                curvature[:n_free, :n_free] += ridge
            moves = np.linalg.lstsq(curvature, slopes.T @ (weights * left), rcond=1e-12)[0]
            left = left - slopes @ moves
        test = weights * left
        pushes = self.answer.pushes.reshape(len(test), -1)
        along = pushes.T @ test
        scatter = float(test @ (self.answer.white.reshape(-1) * left) + along @ along / len(along))
        return float(left @ test) / scatter if scatter > 0.0 else 1.0

    def left(self, rival: Hypothesis, vectors: FloatArray) -> FloatArray:
        """What a rival leaves at other parameters (n, n_parameters), (n,).

        Unknown starts are eliminated by the slopes here.
        """
        truth, n_free = self.answer, len(self.joint) - 1
        outputs = rival.simulator.trajectories(vectors, truth.record, truth.n_steps)
        weights = truth.weights.reshape(-1)
        errors = (truth.outputs - outputs).reshape(len(vectors), -1)
        errors = np.where(weights > 0.0, errors, 0.0)
        starts = self.slopes[:, n_free:]
        with np.errstate(over="ignore", invalid="ignore"):  # of a simulation that blows up
            whole: FloatArray = np.sum(weights * errors**2, axis=1)
            if starts.shape[1]:
                push = errors @ (weights[:, None] * starts)
                inverse = pinvh(starts.T @ (weights[:, None] * starts))
                whole -= np.einsum("ni,ij,nj->n", push, inverse, push)
        return whole


def contrast(truth: Answer, rival: Hypothesis, chromosome: FloatArray) -> Contrast:
    """What a rival at a chromosome (n_free,) leaves of an answer."""
    n_free, vector = len(chromosome), rival.space.full(chromosome)
    outputs = rival.simulator.trajectories(vector[None], truth.record, truth.n_steps)[0]
    slopes = rival.informant.tangents(truth.record, chromosome, truth.n_steps)
    columns = slopes.reshape(truth.outputs.size, -1)
    errors = (truth.outputs - outputs).reshape(-1)
    counted = truth.weights.reshape(-1) > 0.0
    columns, errors = np.where(counted[:, None], columns, 0.0), np.where(counted, errors, 0.0)
    beside = np.column_stack([columns[:, :n_free], errors, columns[:, n_free:]])
    with np.errstate(over="ignore", invalid="ignore"):  # of a simulation that blows up
        joint = beside.T @ (truth.weights.reshape(-1)[:, None] * beside)
    if not np.isfinite(joint).all():
        failed = np.full((n_free + 1, n_free + 1), np.inf)
        return Contrast(truth, errors, columns, failed)
    return Contrast(truth, errors, columns, without_starts(joint, n_free + 1))


def scaled(truth: Answer, rival: Hypothesis, chromosome: FloatArray) -> FloatArray:
    """The M of a run in units of noncentrality, (n_free + 1, n_free + 1).

    A run in which the rival fails counts as one that tells nothing.
    """
    each = contrast(truth, rival, chromosome)
    if not np.isfinite(each.joint).all():
        return np.zeros_like(each.joint)
    matrix: FloatArray = each.efficiency(rival.ridge) * each.joint
    return matrix


def remainders(joint: FloatArray, ridge: FloatArray) -> FloatArray:
    """What refits leave, (...), of sums of M (..., n_free + 1, n_free + 1) with damping ridge."""
    curvature, push = joint[..., :-1, :-1] + ridge, joint[..., :-1, -1]
    moves = np.linalg.solve(curvature, push[..., None])[..., 0]
    left: FloatArray = joint[..., -1, -1] - np.sum(push * moves, axis=-1)
    return np.maximum(left, 0.0)


def noncentrality(answers: Sequence[Answer], rival: Hypothesis, chromosome: FloatArray) -> float:
    """Of the test of a rival at a chromosome (n_free,) on all answers."""
    contrasts = [contrast(truth, rival, chromosome) for truth in answers]
    return float(sum(each.efficiency() * each.joint[-1, -1] for each in contrasts))


def refit(answers: Sequence[Answer], rival: Hypothesis, start: FloatArray) -> FloatArray:
    """Chromosome (n_free,) within the ranges at which a rival leaves least of all answers.

    Damped Gauss-Newton steps along exact tangents, the best of several dampings each (Marquardt,
    "An algorithm for least-squares estimation of nonlinear parameters", 1963), from a chromosome.
    """
    space, small, damping = rival.space, 0, _DAMPING
    low, high = space.coded_lower, space.coded_lower + space.width
    at = np.clip(space.encode(start), low, high)
    joint, contrasts = _joint(answers, rival, at)
    for _ in range(_ITERATIONS):
        left = float(joint[-1, -1])
        if not np.isfinite(left) or left < _NOTHING or small == _PATIENCE:
            break
        weights = damping * _DAMPINGS
        offers = np.clip(at + _moves(joint, rival.ridge, weights, at <= low, at >= high), low, high)
        rest = _rest(contrasts, rival, offers)
        best = int(np.argmin(rest))
        moved = _joint(answers, rival, offers[best]) if rest[best] < left else None
        # Where it has no tangents there is no going on: rather less far.
        if moved is None or not np.isfinite(moved[0]).all():
            damping = float(weights[-1])
            if damping > _HEAVIEST:
                break
            continue
        at, damping = offers[best], float(max(weights[best], _LIGHTEST))
        joint, contrasts = moved
        small = small + 1 if left - rest[best] < min(_ENOUGH * left, _LITTLE) else 0
    return space.decode(at)


def _joint(
    answers: Sequence[Answer], rival: Hypothesis, at: FloatArray
) -> tuple[FloatArray, list[Contrast]]:
    """The M of all answers at coordinates (n_free,), and what it is the sum of."""
    contrasts = [contrast(each, rival, rival.space.decode(at)) for each in answers]
    total: FloatArray = np.sum([each.joint for each in contrasts], axis=0)
    return total, contrasts


def _rest(contrasts: Sequence[Contrast], rival: Hypothesis, coded: FloatArray) -> FloatArray:
    """What is left of all answers at coordinates (n, n_free), infinite where one may not stand."""
    chromosomes = rival.space.decode(coded)
    places = [k for k, each in enumerate(chromosomes) if rival.space.feasible(each)]
    left = np.full(len(coded), np.inf)
    if places:
        vectors = rival.space.full(chromosomes[places])
        left[places] = sum(each.left(rival, vectors) for each in contrasts)
    return np.where(np.isnan(left), np.inf, left)


def _moves(
    joint: FloatArray, ridge: FloatArray, dampings: FloatArray, low: BoolArray, high: BoolArray
) -> FloatArray:
    """Damped steps, (n_dampings, n_free), none across a bound on which a coordinate stands."""
    curvature, push = joint[:-1, :-1], joint[:-1, -1]
    moves = np.zeros((len(dampings), len(push)))
    for move, damping in zip(moves, dampings, strict=True):
        damped = curvature + ridge + damping * np.diag(np.diag(curvature))
        move[:] = np.linalg.solve(damped, push)
        across = (low & (move < 0.0)) | (high & (move > 0.0))
        if across.any():
            inside = np.flatnonzero(~across)
            move[across] = 0.0
            move[inside] = np.linalg.solve(damped[np.ix_(inside, inside)], push[inside])
    return moves
