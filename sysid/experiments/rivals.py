"""Rival structures, refitted to what a run would log if another structure were right.

Structure i says that a run logs y_i. Of a rival j at coordinates x let e = y_i - y_j(x) be what is
left, S its tangents, and V the covariance of the samples' errors, noise of measured inputs included
(``error_filter``). All that matters of a run, as long as x moves little, is

    M = [S e]' V^-1 [S e]

which adds over runs as information does. What the best x leaves is the Schur complement of the last
entry, e' V^-1 e - e' V^-1 S (S' V^-1 S)^-1 S' V^-1 e: the T-criterion (Atkinson and Fedorov, "The
design of experiments for discriminating between two rival models", Biometrika 62, 1975). It is the
noncentrality of the likeliest test between the two, that along V^-1 e.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import pinvh

from sysid.arrays import BoolArray, FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.experiments.error_filter import ErrorFilter
from sysid.experiments.information import Informant, without_starts
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

_ITERATIONS = 100  # of a refit
_ROUNDING = 1e-12  # of a curvature
_HEAT = 4  # iterations after which the worse half of several refits is given up
_LOOSE = 0.05  # share of samples that may err by more than noise foretells
_DAMPING = 1e-2  # with which one begins, in parts of the curvature
_LIGHTEST, _HEAVIEST = 1e-6, 1e4
_DAMPINGS = 10.0 ** np.arange(-3.0, 5.0)  # that are tried at once, as many as there are lanes


@dataclass(frozen=True)
class Effort:
    """Where a refit ends.

    share, most: what an iteration is to gain, in parts of what is left, and that suffices; so many
    times in a row (``patience``) it may gain less, and none if its tangents promise less. nothing:
    what is left of which nothing need be fitted.
    """

    share: float
    most: float
    patience: int
    nothing: float

    def little(self, gain: float, left: float) -> bool:
        """Whether a gain decides nothing."""
        return gain < min(self.share * left, self.most)


ROUGH = Effort(share=0.1, most=np.inf, patience=2, nothing=0.5)
FULL = Effort(share=0.01, most=0.5, patience=3, nothing=0.01)


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


@dataclass(frozen=True, eq=False)
class Answer:
    """What a run would log if a structure were right; the same object twice: a run made twice.

    outputs: (n_samples, n_outputs). error_filter: of the errors of all of them. n_steps: of the
    integration, for all structures.
    """

    record: Dataset
    outputs: FloatArray
    error_filter: ErrorFilter
    n_steps: int

    @property
    def steady(self) -> bool:
        """Whether its simulation did not fail, and errors are nearly in proportion to noise.

        Where noise decides when a shaft comes to rest what rivals leave has many minima, and a fit
        to a log ends in any of them.
        """
        finite = bool(np.isfinite(self.outputs).all()) and self.error_filter.finite
        return finite and self.error_filter.loose <= _LOOSE


def answer(structure: Hypothesis, record: Dataset, n_steps: int) -> Answer:
    """What a structure says that a run of a record's inputs logs."""
    vector = structure.space.full(structure.values)
    outputs = structure.simulator.trajectories(vector[None], record, n_steps)[0]
    error_filter = structure.informant.error_filter(record, vector, outputs, n_steps)
    return Answer(record, outputs, error_filter, n_steps)


@dataclass(frozen=True, eq=False)
class Contrast:
    """What a rival leaves of an answer, and how it would move.

    joint: (n_free + 1, n_free + 1), the M above, unknown starts eliminated; infinite where a
    simulation failed. starts: (n_samples * n_outputs, n_unknown), whitened slopes of these.
    """

    answer: Answer
    starts: FloatArray
    joint: FloatArray

    def left(self, rival: Hypothesis, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What a rival leaves at other parameters (n, n_parameters), (n,), and its outputs there.

        Unknown starts are eliminated by the slopes here. Outputs: (n, n_samples, n_outputs).
        """
        truth, starts = self.answer, self.starts
        outputs = rival.simulator.trajectories(vectors, truth.record, truth.n_steps)
        with np.errstate(over="ignore", invalid="ignore"):  # of a simulation that blows up
            errors = truth.error_filter.of((truth.outputs - outputs).reshape(len(vectors), -1).T)
            left: FloatArray = np.sum(errors**2, axis=0)
            if starts.shape[1]:
                push = starts.T @ errors
                left -= np.sum(push * (pinvh(starts.T @ starts) @ push), axis=0)
        return left, outputs


def contrast(
    truth: Answer, rival: Hypothesis, chromosome: FloatArray, outputs: FloatArray | None = None
) -> Contrast:
    """What a rival at a chromosome (n_free,) leaves of an answer.

    outputs: (n_samples, n_outputs), the rival's, where they have been simulated.
    """
    n_free = len(chromosome)
    if outputs is None:
        vector = rival.space.full(chromosome)[None]
        outputs = rival.simulator.trajectories(vector, truth.record, truth.n_steps)[0]
    slopes = rival.informant.tangents(truth.record, chromosome, truth.n_steps)
    columns = slopes.reshape(outputs.size, -1)
    errors = (truth.outputs - outputs).reshape(-1)
    beside = np.column_stack([columns[:, :n_free], errors, columns[:, n_free:]])
    with np.errstate(over="ignore", invalid="ignore"):  # of a simulation that blows up
        beside = truth.error_filter.of(beside)
        joint = beside.T @ beside
    if not np.isfinite(joint).all():
        failed = np.full((n_free + 1, n_free + 1), np.inf)
        return Contrast(truth, beside[:, n_free + 1 :], failed)
    return Contrast(truth, beside[:, n_free + 1 :], without_starts(joint, n_free + 1))


def remainders(joint: FloatArray, ridge: FloatArray) -> FloatArray:
    """What refits leave, (...), of sums of M (..., n_free + 1, n_free + 1) with damping ridge."""
    n = joint.shape[-1] - 1
    # What nothing tells apart has a curvature that rounding may make singular.
    curvature = joint[..., :-1, :-1] * (1.0 + _ROUNDING * np.eye(n)) + ridge
    push = joint[..., :-1, -1]
    moves = np.linalg.solve(curvature, push[..., None])[..., 0]
    left: FloatArray = joint[..., -1, -1] - np.sum(push * moves, axis=-1)
    return np.maximum(left, 0.0)


def refit(
    answers: Sequence[Answer], rival: Hypothesis, *starts: FloatArray, effort: Effort = FULL
) -> tuple[FloatArray, float]:
    """Chromosome (n_free,) in the ranges at which a rival leaves least of all answers, and what.

    From several chromosomes, of which the worse half are given up after each few iterations.
    """
    fits = [RivalFit(answers, rival, start, effort) for start in starts]
    while len(fits) > 1:
        for fit in fits:
            fit.advance(_HEAT)
        fits.sort(key=lambda fit: fit.left)
        fits = fits[: len(fits) // 2]
    (fit,) = fits
    fit.advance(_ITERATIONS)
    return rival.space.decode(fit.at), fit.left


class RivalFit:
    """Damped Gauss-Newton steps along exact tangents, the best of several dampings each.

    Marquardt, "An algorithm for least-squares estimation of nonlinear parameters" (1963). at:
    coordinates so far, (n_free,).
    """

    def __init__(
        self, answers: Sequence[Answer], rival: Hypothesis, start: FloatArray, effort: Effort
    ) -> None:
        space = rival.space
        self._answers, self._rival, self._effort = Counter(answers), rival, effort
        self._low, self._high = space.coded_lower, space.coded_lower + space.width
        self._small, self._damping = 0, _DAMPING
        self.at = np.clip(space.encode(start), self._low, self._high)
        self._joint, self._contrasts = _joint(self._answers, rival, self.at)

    @property
    def left(self) -> float:
        """What is left of all answers, infinite where a simulation failed."""
        return float(self._joint[-1, -1])

    @property
    def ended(self) -> bool:
        """Whether nothing more is to be gained."""
        left, effort = self.left, self._effort
        if not effort.nothing <= left < np.inf or self._damping > _HEAVIEST:
            return True
        promised = left - float(remainders(self._joint, self._rival.ridge))
        return self._small >= effort.patience or effort.little(promised, left)

    def advance(self, iterations: int) -> None:
        """At most so many further steps."""
        for _ in range(iterations):
            if self.ended:
                return
            self._step()

    def _step(self) -> None:
        low, high, at, left = self._low, self._high, self.at, self.left
        weights = self._damping * _DAMPINGS
        moves = _moves(self._joint, self._rival.ridge, weights, at <= low, at >= high)
        offers = np.clip(at + moves, low, high)
        rest, outputs = _rest(self._contrasts, self._rival, offers)
        best = int(np.argmin(rest))
        # Where it has no tangents there is no going on: rather less far.
        joint, contrasts = np.full((1, 1), np.inf), self._contrasts
        if rest[best] < left:
            of_best = {each: of_all[best] for each, of_all in outputs.items()}
            joint, contrasts = _joint(self._answers, self._rival, offers[best], of_best)
        if not np.isfinite(joint).all():
            self._damping = float(weights[-1])
            return
        self.at, self._joint, self._contrasts = offers[best], joint, contrasts
        self._damping = float(max(weights[best], _LIGHTEST))
        little = self._effort.little(left - self.left, left)
        self._small = self._small + 1 if little else 0


def _joint(
    answers: Mapping[Answer, int],
    rival: Hypothesis,
    at: FloatArray,
    outputs: Mapping[Answer, FloatArray] | None = None,
) -> tuple[FloatArray, Counter[Contrast]]:
    """The M of all answers, each so often, at coordinates (n_free,), and what it is the sum of.

    outputs: the rival's there by the answer, where they have been simulated.
    """
    chromosome, outputs = rival.space.decode(at), outputs or {}
    contrasts = Counter({
        contrast(each, rival, chromosome, outputs.get(each)): k for each, k in answers.items()
    })  # fmt: skip
    total: FloatArray = np.sum([k * each.joint for each, k in contrasts.items()], axis=0)
    return total, contrasts


def _rest(
    contrasts: Mapping[Contrast, int], rival: Hypothesis, coded: FloatArray
) -> tuple[FloatArray, dict[Answer, dict[int, FloatArray]]]:
    """What is left of all answers at coordinates (n, n_free), infinite where one may not stand.

    And the rival's outputs, by the answer and the coordinates' place.
    """
    chromosomes = rival.space.decode(coded)
    places = [k for k, each in enumerate(chromosomes) if rival.space.feasible(each)]
    left, simulated = np.full(len(coded), np.inf), {}
    if places:
        vectors = rival.space.full(chromosomes[places])
        left[places] = 0.0
        for each, count in contrasts.items():
            of_it, outputs = each.left(rival, vectors)
            left[places] += count * of_it
            simulated[each.answer] = dict(zip(places, outputs, strict=True))
    return np.where(np.isnan(left), np.inf, left), simulated


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
