"""Score tests of what a model may lack, and how far it would move the parameters.

With e the residuals at the estimate, S the slopes of the outputs over the parameters, and D the
change of the outputs by a suspect's amplitudes (see ``suspects``), all whitened by the residuals'
autoregression, e is regressed on S alone and on S and D together. Of the part of D that no change
of the parameters makes, r = D - S S+ D, the score r'e is zero in the mean where the suspect is
not there: its square in units of its covariance is a chi-square (the Lagrange multiplier test;
Breusch & Pagan, Review of Economic Studies 47, 1980). The difference of the two regressions'
parameters is the Gauss-Newton step by which the suspect, were it fitted as well, moves them.

What is known beforehand keeps the regression from using what is no freedom: a factor of e of each
parameter, a channel's zero by as much as its calibration left open. The covariance of the score
is the largest of three, since a whitened residual is white in the mean only: that of white
residuals; their own, whatever their variance along the record and with what colour is left
(Newey & West, Econometrica 55, 1987); and that of the known noise of the inputs. The suspect with
the smallest probability is taken into the regression, and the rest asked again.
"""

import math
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.objective import Objective
from sysid.judging.disturbed import DisturbedRun, of_each
from sysid.judging.suspects import (
    Kind,
    Suspect,
    change_suspects,
    channel_suspects,
    disturbance_suspects,
    function_suspects,
    head,
    in_single_records,
    likely_noise,
    variant_suspects,
)
from sysid.problem.model import ModelError
from sysid.problem.terms import AddedTerm
from sysid.threads import Workers
from sysid.uncertainty import Estimate, Uncertainty
from sysid.uncertainty.colour import Autoregression, colour, longest_memory, record_rows
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    input_noises,
    sensitivity,
    spans,
    zero_errors,
)
from sysid.uncertainty.ties import free_gradient, named_values

_CHANCE = 1e-3  # probability of a finding by chance, all tests together
_SEVERAL = ("variant", "function", "disturbance")  # have no single amplitude
_MOST = 5  # findings
_MOST_SAMPLES = 10_000  # that are tested: beyond, what matters has long been significant
_AS_MUCH = 0.95  # of what another explains, that counts as the same
_LIKELY = 8  # suspects that are tested side by side, and again by the colour of what they leave
_LAGS = 20  # of what colour whitening may leave
_FORGETS = 20  # samples of a record that count as independent, from where its mean is no colour
_NEW = 1e-2  # share of a suspect that no change of the parameters makes, below which it is theirs
_INEXACT = 1e-2  # of the residuals' deviation, from where a simulation's error shows in them
# Standard deviations by which a finding moves a parameter noticeably: an interval reaches 1.96. And
# share of the residuals that it explains, from where it counts whatever it moves.
MOVED, _LARGE = 1.5, 0.25
_NEARLY_ALL = 0.9  # of what is left, beside which a line's guess leaves what looks like anything
_TURNED = -1.3  # change of a gain that is 1, below which it is its sign that is wrong
_TIMES = (0.5, 2.5, 21)  # delays that are tried, in parts of what a small one tells
_REACH = 10.0  # of a term's range in parts of the size that its test found
# Standard deviation of a coordinate before the data: a factor of e; where an end of a range decides
# its value, the data want it elsewhere, and nobody knows where.
_FREEDOM, _UNBOUND = 1.0, 1e6


@dataclass(frozen=True)
class Move:
    """By how much a finding would move a quantity, in its unit and in standard deviations."""

    quantity: Estimate
    change: float
    deviations: float


def moves_of(estimates: Iterable[Estimate], changes: Iterable[float]) -> tuple[Move, ...]:
    """Moves of the estimates that have a deviation, the farthest first."""
    moves = [
        Move(e, c, c / e.deviation) for e, c in zip(estimates, changes, strict=True) if e.deviation
    ]
    return tuple(sorted(moves, key=lambda move: -abs(move.deviations)))


@dataclass(frozen=True)
class Finding:
    """Something that the model lacks: what it is, how sure, and what it would move.

    name, unit: as of its suspect. amplitude: of a channel's fault, in the unit; None of others.
    term: of a function the one that it is most like, with a range to fit it in. of_input: whether
    a channel is an input. p_value: by chance,
    all tests counted. share: of the whitened residuals' squares that it explains. moves: the
    farthest first.
    """

    kind: Kind
    name: str
    unit: str
    amplitude: float | None
    p_value: float
    share: float
    moves: tuple[Move, ...]
    term: AddedTerm | None = None
    of_input: bool = False

    @property
    def farthest(self) -> float:
        """Standard deviations by which it moves what it moves farthest."""
        return abs(self.moves[0].deviations) if self.moves else 0.0

    @property
    def counts(self) -> bool:
        """Whether it moves a parameter noticeably, or is much of what is left."""
        return self.farthest > MOVED or self.share > _LARGE

    @property
    def comes_late(self) -> bool:
        """Whether it is a channel's delay, or what is one of a little."""
        return self.kind in ("delay", "filter", "lag")

    @property
    def explains(self) -> bool:
        """Whether next to nothing is left with a channel's fault taken out."""
        return self.amplitude is not None and self.share > _NEARLY_ALL

    @property
    def turned_round(self) -> bool:
        """Whether a channel has the opposite sign of what the model has."""
        return self.kind == "gain" and (self.amplitude or 0.0) < _TURNED


def missing_physics(
    objective: Objective, chromosome: FloatArray, uncertainty: Uncertainty
) -> tuple[Finding, ...]:
    """What the model lacks by the records of an objective at its minimum, the surest first.

    Faults of channels and the model's variants are tried before functions in the equations.
    Raises ModelError where the free run at the chromosome fails.
    """
    return ScoreTests(objective, chromosome).findings(uncertainty)


class ScoreTests:
    """Tests at a minimum, (n_free,), with all that they take but the parameters' intervals.

    objective: of the free run's errors, or whose ``free_run`` is. Raises ModelError where the free
    run fails.
    """

    def __init__(self, objective: Objective, chromosome: FloatArray) -> None:
        records = head(objective.records, _MOST_SAMPLES)
        local = sensitivity(objective.free_run.on(records), chromosome)
        # Smaller errors than those of the simulation are these.
        left = np.max(np.sqrt(np.mean(local.residual**2, axis=0)))
        self._exact = bool(left < objective.simulator.accuracy)
        if self._exact:
            return
        self._runs = runs = _runs(local)
        noisy = [runs[0].model.input_names[i] for i in np.flatnonzero(records[0].input_noise)]
        channels = list(channel_suspects(runs))
        # Noise of an input makes its gain look smaller: that is no fault.
        channels = [s for s in channels if s.kind != "gain" or s.name not in noisy]
        foreseen = np.concatenate([_foreseen_noise(runs), _simulation_error(runs, local)], axis=2)
        self._tests = _Tests(local, foreseen, _noisy_starts(runs, local), runs[0].workers)
        channels += in_single_records([s for s in channels if s.kind != "noise"], runs)
        self._named = [*channels, *variant_suspects(runs)]

    @cached_property
    def functions(self) -> list[Suspect]:
        """Functions in the equations, for which there may be no need."""
        if self._exact:
            return []
        return [*function_suspects(self._runs), *disturbance_suspects(self._runs)]

    def findings(self, uncertainty: Uncertainty) -> tuple[Finding, ...]:
        """What the model lacks, the surest first, and how far it moves what has intervals."""
        if self._exact:
            return ()
        names, tests = self._runs[0].model.parameter_names, self._tests.of(uncertainty)
        alone = [e.name for e in uncertainty.determined() if e.name in names]
        tests.admit([*self._named, *change_suspects(self._runs, alone)])
        if not any(finding.kind == "variant" or finding.explains for finding in tests.findings):
            tests.admit(self.functions)
        return tests.settled()


def _runs(local: Sensitivity) -> list[DisturbedRun]:
    objective, chromosomes = local.objective, local.chromosome[None]
    model, vector = objective.simulator.model, objective.space.full(chromosomes)[0]
    workers, runs = Workers(objective.simulator.threads), []
    for k, record in enumerate(objective.records):
        start = objective.space.starts(chromosomes, k, record.initial_state(model))[0]
        runs.append(DisturbedRun(model, vector, record, start, workers))
    return runs


def _foreseen_noise(runs: Sequence[DisturbedRun]) -> FloatArray:
    """What the noise of inputs is likely to have done to the outputs, (n_rows, n_outputs, k).

    Given what was measured, noise is not zero in the mean: a Wiener filter tells what of an input
    it probably is. Uncorrelated with any linear function of what was measured is only the rest.
    """
    records = [run.record for run in runs]
    columns = []
    noisy = np.any([record.input_noise for record in records], axis=0)
    for i in np.flatnonzero(noisy).tolist():
        columns.append(of_each(runs, partial(_likely_noise, i)))
    n = sum(record.n_samples for record in records)
    return np.stack(columns, axis=2) if columns else np.zeros((n, runs[0].outputs.shape[1], 0))


def _likely_noise(i: int, run: DisturbedRun) -> FloatArray:
    """What the noise of input i is likely to have done to the outputs, (n_samples, n_outputs)."""
    part = np.zeros(run.record.inputs.shape)
    part[:, i] = likely_noise(run.record.inputs[:, i], float(run.record.input_noise[i]))
    return run.driven(part)


def _simulation_error(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """What a finer integration changes in the outputs, (n_rows, n_outputs, 1); none if little."""
    pieces = []
    for run, rows, scale in zip(
        runs, record_rows(local.lengths), local.objective.scales, strict=True
    ):
        left = local.residual[rows] * scale
        coarse = np.where(local.seen[rows], run.record.outputs + left, run.outputs)
        pieces.append(run.outputs - coarse)
    error = np.concatenate(pieces)[..., None]
    size = np.sqrt(np.mean(error[..., 0] ** 2, axis=0))
    left = np.sqrt(np.mean(local.residual**2, axis=0)) * np.mean(local.objective.scales, axis=0)
    return error if np.any(size > _INEXACT * left) else error[..., :0]


def _noisy_starts(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """Changes (n_rows, n_outputs, k) by one noise of each first sample at which a run starts."""
    lengths = tuple(run.record.n_samples for run in runs)
    columns = [np.zeros((sum(lengths), runs[0].outputs.shape[1], 0))]
    places = zip(runs, record_rows(lengths), local.objective.scales, strict=True)
    for run, rows, scale in places:
        left = local.residual[rows] * scale
        for place, j in enumerate(run.record.starts_at_samples(run.model)):
            if j is not None:
                column = np.zeros((*columns[0].shape[:2], 1))
                deviation = run.record.sample_noise(j, left[:, j])
                column[rows, :, 0] = deviation * run.started(place)
                columns.append(column)
    return np.concatenate(columns, axis=2)


class _Tests:
    """Regression of residuals, to which suspects are admitted one after another.

    Columns are (n_residuals, n_outputs, k), in parts of the outputs' scales.
    """

    findings: list[Finding]
    _ends: list[int]
    _estimates: list[Estimate]
    _gradients: FloatArray

    def __init__(
        self, local: Sensitivity, foreseen: FloatArray, chance: FloatArray, workers: Workers
    ) -> None:
        """Of changes that are there whatever is missing, (n_residuals, n_outputs, k) each.

        foreseen: of any size. chance: by one standard deviation of what is known to be so large.
        """
        self._workers = workers
        self._local, self._residual = local, -local.residual
        self._scales = np.concatenate(
            [
                np.broadcast_to(scale, (n, len(scale)))
                for scale, n in zip(local.objective.scales, local.lengths, strict=True)
            ]
        )
        zeros = [zero[..., None] for zero in zero_errors(local)]
        foreseen, chance = (part / self._scales[..., None] for part in (foreseen, chance))
        self._columns = np.concatenate([local.slopes, *zeros, chance, foreseen], axis=2)
        on_bound = local.objective.space.on_bound(local.chromosome)
        freedom = np.where(on_bound, _UNBOUND, _FREEDOM)
        self._free = np.concatenate(
            [
                1.0 / (freedom * spans(local.objective, local.chromosome)),
                np.ones(len(zeros) + chance.shape[2]),
                np.zeros(foreseen.shape[2]),
            ]
        )
        self._noises = list(input_noises(local))
        self._regression = self._coloured_by(self._residual)

    def of(self, uncertainty: Uncertainty) -> Self:
        """The same, before any suspect is admitted, of what has intervals."""
        tests = copy(self)
        tests.findings = []
        tests._ends = [self._columns.shape[2]]  # of the columns until each finding
        tests._estimates = [e for e in uncertainty.determined() if e.deviation]
        gradients = [_gradient(self._local, e) for e in tests._estimates]
        tests._gradients = np.array(gradients).reshape(-1, self._local.slopes.shape[2])
        return tests

    def admit(self, suspects: Sequence[Suspect]) -> None:
        """Admit the suspects that are there by more than chance, each given those before it."""
        changes = [s.changes / self._scales[..., None] for s in suspects]
        left = [i for i, change in enumerate(changes) if np.any(change)]
        # A channel that is late by this or that is one suspect.
        late = {(suspects[i].kind, suspects[i].name) for i in left if suspects[i].late is not None}
        tests = len(late) + sum(suspects[i].late is None for i in left)
        while left and len(self.findings) < _MOST:
            first = self._likeliest(changes, suspects, left)
            again = self._workers.results(
                lambda task: self._again(*task),
                [(changes[i], suspects[i], test) for i, test in first.items()],
            )
            results = dict(zip(first, again, strict=True))
            logs = {i: result.log_p + np.log(tests) for i, (result, _) in results.items()}
            significant = [i for i in logs if logs[i] < np.log(_CHANCE)]
            if not significant:
                return
            # Of probabilities too small for a number what explains more decides.
            alike = [i for i in significant if logs[i] == min(logs.values())]
            enough = _AS_MUCH * max(results[i][0].share for i in alike)
            surest = next(i for i in alike if results[i][0].share >= enough)
            result, residual = results[surest]
            if suspects[surest].late is not None:
                # A delay, a filter and a lag of a little are one; of more they are not.
                sized = {
                    i: self._as_late(suspects[i], *results[i])
                    for i in significant
                    if suspects[i].late is not None and suspects[i].name == suspects[surest].name
                }
                surest = min(sized, key=lambda i: float(np.sum(sized[i][2] ** 2)))
                changes[surest], result, residual = sized[surest]
            term = self._term(suspects[surest], changes[surest], residual)
            self.findings.append(self._finding(suspects[surest], result, logs[surest], term))
            size = np.sqrt(np.mean(changes[surest] ** 2, axis=(0, 1)))
            admitted = changes[surest][..., size > 0.0] / size[size > 0.0]
            self._columns = np.concatenate([self._columns, admitted], axis=2)
            self._free = np.concatenate([self._free, np.zeros(admitted.shape[2])])
            self._ends.append(len(self._free))
            self._regression = self._coloured_by(residual)
            left = [i for i in left if i != surest and not suspects[i].same(suspects[surest])]

    def _likeliest(
        self, changes: Sequence[FloatArray], suspects: Sequence[Suspect], left: Sequence[int]
    ) -> dict[int, "_Result"]:
        """Tests of the suspects whose probabilities are the smallest, of different ones.

        In order of what the probabilities are at least, until the rest cannot be among them.
        """
        bounds = self._workers.results(
            lambda i: self._regression.least(changes[i], suspects[i].one_sided), left
        )
        least = dict(zip(left, bounds, strict=True))
        order = sorted(left, key=lambda i: least[i])
        tests: dict[int, _Result] = {}
        likely: list[int] = []
        for first in range(0, len(order), _LIKELY):
            wave = order[first : first + _LIKELY]
            if len(likely) == _LIKELY and least[wave[0]] > tests[likely[-1]].log_p:
                break
            results = self._workers.results(
                lambda i: self._regression.test(changes[i], suspects[i].one_sided), wave
            )
            tests |= {i: result for i, result in zip(wave, results, strict=True) if result}
            likely = []
            for k in sorted(tests, key=lambda k: (tests[k].log_p, k)):
                if len(likely) < _LIKELY and not any(suspects[k].same(suspects[j]) for j in likely):
                    likely.append(k)
        return {i: tests[i] for i in likely}

    def _again(
        self, changes: FloatArray, suspect: Suspect, first: "_Result"
    ) -> tuple["_Result", FloatArray]:
        """A test by the colour of what the suspect leaves, and what it leaves.

        Where it is there, the residuals' colour is mostly its own, and whitening hides it.
        """
        residual = self._left(changes, first)
        second = self._coloured_by(residual).test(changes, suspect.one_sided)
        if second is None or second.log_p > first.log_p:
            return first, residual
        return second, self._left(changes, second)

    def _as_late(
        self, suspect: Suspect, result: "_Result", residual: FloatArray
    ) -> tuple[FloatArray, "_Result", FloatArray]:
        """Changes, test and what is left of a delay as large as explains most of the residuals."""
        assert suspect.late is not None
        regression = self._coloured_by(residual)
        delays = (float(result.amplitudes[0]) * np.linspace(*_TIMES)).tolist()
        late = [suspect.late(delay) / self._scales[..., None] for delay in delays]
        tests = self._workers.results(lambda each: regression.test(each, suspect.one_sided), late)
        best = None
        for delay, changes, test in zip(delays, late, tests, strict=True):
            if test is not None and (best is None or test.share > best[1].share):
                best = changes, test, delay
        if best is None:
            return suspect.changes / self._scales[..., None], result, residual
        changes, test, delay = best
        return changes, replace(test, amplitudes=np.array([delay])), self._left(changes, test)

    def settled(self) -> tuple[Finding, ...]:
        """The findings, with what each explains by the colour that all of them leave.

        By the colour of what was left before, which others had their part in, it is too little.
        """
        whitening, rests = self._regression.whitening, []
        for end in self._ends:
            columns, free = self._columns[..., :end], self._free[:end]
            rests.append(_Regression(whitening, columns, free, self._residual, ()).squares)
        return tuple(
            replace(finding, share=max(1.0 - after / before, 0.0) if before > 0.0 else 0.0)
            for finding, before, after in zip(self.findings, rests, rests[1:], strict=False)
        )

    def _left(self, changes: FloatArray, result: "_Result") -> FloatArray:
        return self._residual - self._columns @ result.coefficients - changes @ result.amplitudes

    def _coloured_by(self, residual: FloatArray) -> "_Regression":
        whitening = _Whitening.of(self._local, residual)
        return _Regression(whitening, self._columns, self._free, self._residual, self._noises)

    def _term(
        self, suspect: Suspect, changes: FloatArray, residual: FloatArray
    ) -> AddedTerm | None:
        """The term of a suspect that by itself explains most; residual: what all leave."""
        regression = self._coloured_by(residual)
        alone = [
            (result.share, float(np.abs(result.amplitudes[0])), term)
            for k, term in enumerate(suspect.terms)
            if (result := regression.test(changes[..., [k]], False)) is not None
        ]
        if not alone:
            return suspect.terms[0] if suspect.terms else None
        _, size, term = max(alone, key=lambda test: test[0])
        reach = float(f"{_REACH * size:.1g}") or 1.0
        return replace(term, low=-reach, high=reach)

    def _finding(
        self, suspect: Suspect, result: "_Result", log_p: float, term: AddedTerm | None
    ) -> Finding:
        moved = self._gradients @ result.move[: self._gradients.shape[1]]
        several, amplitudes = suspect.kind in _SEVERAL, result.amplitudes
        return Finding(
            suspect.kind,
            suspect.name,
            suspect.unit,
            None if several else float(amplitudes[0]),
            float(np.exp(min(log_p, 0.0))),
            result.share,
            moves_of(self._estimates, moved.tolist()),
            term,
            suspect.of_input,
        )


@dataclass(frozen=True)
class _Result:
    """A suspect's test: log of its probability, its amplitudes, and what becomes of the rest.

    coefficients: of the regression's columns beside the suspect; move: what they were moved by.
    """

    log_p: float
    amplitudes: FloatArray
    coefficients: FloatArray
    move: FloatArray
    share: float


class _Regression:
    """Residuals on columns, whitened; free (p,) says how firmly each column stands at zero."""

    def __init__(
        self,
        whitening: "_Whitening",
        columns: FloatArray,
        free: FloatArray,
        residual: FloatArray,
        noises: Sequence[tuple[slice, FloatArray]],
    ) -> None:
        self.whitening = whitening
        white, target = whitening(columns), whitening(residual[..., None])
        self._n = len(target)
        self._basis = _Basis(
            white, free, [whitening.rows_of(r) for r in record_rows(whitening.lengths)]
        )
        within, beyond = self._basis.split(target)
        self._coefficients, self._residual = self._basis.solved(within[:, 0]), beyond[:, 0]
        self._noises = noises
        self.squares = float(self._residual[: self._n] @ self._residual[: self._n])

    def least(self, changes: FloatArray, one_sided: bool) -> float:
        """What the logarithm of a suspect's probability is at least, by its test.

        That of white residuals, which needs no row of what the regression's columns leave.
        """
        columns, size = self._scaled(changes)
        if not columns.size:
            return math.inf
        if one_sided and len(size) > 1:
            return -math.inf
        rows = _span(columns)
        within = self._basis.within(columns[rows], rows)
        squares, axes = np.linalg.eigh(columns[rows].T @ columns[rows] - within.T @ within)
        new = squares > _NEW**2
        score = (axes[:, new].T @ (columns[rows].T @ self._residual[rows])) / np.sqrt(squares[new])
        if not new.any() or (one_sided and axes[0, 0] * score[0] <= 0.0):
            return math.inf
        return _log(float(chdtrc(int(new.sum()), score @ score)))

    def _scaled(self, changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened columns of unit length, those without any left out, and all their lengths."""
        white = self.whitening(changes)
        size = np.linalg.norm(white, axis=0)
        return white[:, size > 0.0] / size[size > 0.0], size

    def test(self, changes: FloatArray, one_sided: bool) -> _Result | None:
        """The test of a suspect's changes; None where the parameters do all that it does.

        one_sided: whether only amplitudes above zero are looked for; their statistic has as many
        degrees of freedom as amplitudes turned out to be (Susko, "Likelihood ratio tests with
        boundary constraints using data-dependent degrees of freedom", Biometrika 100, 2013).
        """
        columns, size = self._scaled(changes)
        if not columns.size:
            return None
        within, beyond = self._basis.split(columns)
        squares, axes = np.linalg.eigh(beyond.T @ beyond)
        new = squares > _NEW**2
        if not new.any():
            return None
        if one_sided:
            from scipy.optimize import nnls  # slow, and seldom needed

            amplitudes = nnls(beyond, self._residual)[0]
            length = float(np.linalg.norm(beyond @ amplitudes))
            if length == 0.0:
                return None
            turn, freedom = (amplitudes / length)[:, None], int(np.count_nonzero(amplitudes))
        else:
            turn, freedom = axes[:, new] / np.sqrt(squares[new]), int(new.sum())
            amplitudes = turn @ (turn.T @ (beyond.T @ self._residual))
        left = beyond @ turn
        score = left.T @ self._residual
        move = -self._basis.solved(within @ amplitudes)
        whole = np.zeros(len(size))
        whole[size > 0.0] = amplitudes / size[size > 0.0]
        return _Result(
            _log(float(chdtrc(freedom, self._statistic(left, score)))),
            whole,
            self._coefficients + move,
            move,
            min(float(score @ score) / max(self.squares, 1e-300), 1.0),
        )

    def _statistic(self, left: FloatArray, score: FloatArray) -> float:
        """The score's square in units of its covariance, in every direction the larger of three."""
        rest = self._residual - left @ score
        terms = (left * rest[:, None])[: self._n]
        terms = terms.reshape(-1, self.whitening.n_outputs, len(score)).sum(axis=1)
        covariance = _long_run_covariance(terms - terms.mean(axis=0))
        if self._noises:
            pushes = self._pushes(left[: self._n])
            covariance = _larger(covariance, pushes @ pushes.T)
        return float(score @ np.linalg.solve(_larger(covariance, np.eye(len(score))), score))

    def _pushes(self, left: FloatArray) -> FloatArray:
        """Changes of the score by draws of the inputs' noise, (k, n_draws of all records)."""
        pushes = []
        for rows, noise in self._noises:
            back = self.whitening.back(rows, left)
            pushes.append(back.T @ noise.reshape(len(back), -1))
        return np.hstack(pushes)


class _Basis:
    """Orthonormal basis of whitened columns (n_rows, p) and what is known of each beforehand.

    free: (p,), as of ``_Regression``; below the rows of the columns stands one for each of them.
    Columns that are in one record alone are factored there, the common ones by what those leave of
    them (Frisch & Waugh, Econometrica 1, 1933): that takes no longer a record the more there are.
    records: rows of each.
    """

    def __init__(self, white: FloatArray, free: FloatArray, records: Sequence[slice]) -> None:
        self._n, self._records = len(white), records
        felt = np.array([white[rows].any(axis=0) for rows in records])
        alone = felt.sum(axis=0) == 1
        self._places = [np.flatnonzero(alone & in_record) for in_record in felt]
        self._common = np.flatnonzero(~alone)
        common = np.vstack([white, np.diag(free)])[:, self._common]
        self._bases, self._triangles, self._parts = [], [], []
        for rows, places in zip(records, self._places, strict=True):
            basis, triangle = np.linalg.qr(np.vstack([white[rows, places], np.diag(free[places])]))
            count = rows.stop - rows.start
            part = basis[:count].T @ common[rows]
            common[rows] -= basis[:count] @ part
            common[self._n + places] -= basis[count:] @ part
            self._bases.append((basis[:count], basis[count:]))
            self._triangles.append(triangle)
            self._parts.append(part)
        self._common_basis, self._common_triangle = np.linalg.qr(common)

    def within(self, white: FloatArray, rows: slice) -> FloatArray:
        """Scalar products with the basis, (p, k), of columns that are zero outside some rows."""
        within = np.zeros((len(self._common_basis) - self._n, white.shape[1]))
        within[self._common] = self._common_basis[rows].T @ white
        for record, places, (basis, _) in zip(
            self._records, self._places, self._bases, strict=True
        ):
            first, end = max(record.start, rows.start), min(record.stop, rows.stop)
            if first < end and len(places):
                part = white[first - rows.start : end - rows.start]
                within[places] = basis[first - record.start : end - record.start].T @ part
        return within

    def split(self, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scalar products of whitened columns with the basis, and what it leaves of them.

        The latter with rows for what is known beforehand.
        """
        rows = _span(white)
        within = self.within(white[rows], rows)
        beyond: FloatArray = -(self._common_basis @ within[self._common])
        for record, places, (basis, below) in zip(
            self._records, self._places, self._bases, strict=True
        ):
            beyond[record] -= basis @ within[places]
            beyond[self._n + places] -= below @ within[places]
        beyond[rows] += white[rows]
        return within, beyond

    def solved(self, within: FloatArray) -> FloatArray:
        """Coefficients (p,) of the columns from scalar products (p,) with the basis."""
        solution = np.zeros_like(within)
        common = solve_triangular(self._common_triangle, within[self._common])
        solution[self._common] = common
        for places, triangle, part in zip(self._places, self._triangles, self._parts, strict=True):
            solution[places] = solve_triangular(triangle, within[places] - part @ common)
        return solution


def _span(white: FloatArray) -> slice:
    """Rows from the first to the last in which columns are not zero."""
    rows = np.flatnonzero(white.any(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)


def _larger(first: FloatArray, second: FloatArray) -> FloatArray:
    """A covariance as large in every direction as the larger of two."""
    values, vectors = np.linalg.eigh(first)
    floor = 1e-9 * max(float(values[-1]), float(np.trace(second)))
    root = vectors * np.sqrt(np.maximum(values, floor))
    back = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(back @ second @ back.T)
    whole = root @ axes
    larger: FloatArray = (whole * np.maximum(ratio, 1.0)) @ whole.T
    return larger


def _long_run_covariance(terms: FloatArray) -> FloatArray:
    """Covariance of the sum of correlated terms (n, k) of mean zero, with Bartlett's weights."""
    total: FloatArray = terms.T @ terms
    for lag in range(1, min(_LAGS, len(terms) // 4)):
        product = terms[lag:].T @ terms[:-lag]
        total = total + (1.0 - lag / _LAGS) * (product + product.T)
    # The weights keep it from being negative but for rounding.
    return total


@dataclass(frozen=True)
class _Whitening:
    """Takes the residuals' colour out of columns (n_residuals, n_outputs, k): (n_rows, k).

    kept: rows whose past the autoregression knows. decorrelate: (n_outputs, n_outputs).
    """

    model: Autoregression
    lengths: tuple[int, ...]
    kept: BoolArray
    decorrelate: FloatArray

    @classmethod
    def of(cls, local: Sensitivity, residual: FloatArray) -> "_Whitening":
        """By residuals (n_residuals, n_outputs); of outputs that do not count none are left."""
        counted = local.objective.weights > 0.0
        measured = counted & local.seen
        residual = np.where(measured, residual, 0.0)
        model = colour_about_line(residual, local.seen, measured, local.lengths)
        values, vectors = np.linalg.eigh(model.noise)
        floor = 1e-12 * max(float(values[-1]), 1e-300)
        roots = np.where(values > floor, 1.0 / np.sqrt(np.maximum(values, floor)), 0.0)
        whole = np.all(local.seen | ~local.seen.any(axis=0), axis=1)
        kept, order = whole.copy(), len(model.coefficients)
        for rows in record_rows(local.lengths):
            for k in range(1, order + 1):
                kept[rows][k:] &= whole[rows][:-k]
            kept[rows][:order] = False
        return cls(model, local.lengths, kept, (vectors * roots) @ vectors.T)

    @cached_property
    def n_outputs(self) -> int:
        """Columns of the residuals."""
        return len(self.decorrelate)

    @cached_property
    def _filter(self) -> FloatArray:
        """What makes a sample of it and those before, the oldest first, (q, (order + 1) q)."""
        parts = [-matrix for matrix in self.model.coefficients[::-1]]
        whole: FloatArray = self.decorrelate @ np.hstack([*parts, np.eye(self.n_outputs)])
        return whole

    def __call__(self, columns: FloatArray) -> FloatArray:
        """The whitened columns, rows of outputs one after another."""
        whole = np.zeros((self.n_outputs * int(self.kept.sum()), columns.shape[2]))
        for rows, places in self._records:
            if columns[rows].any():
                whole[places] = self.of_record(rows, columns[rows])
        return whole

    @cached_property
    def _records(self) -> list[tuple[slice, slice]]:
        """Each record's rows of the residuals and of the whitened columns."""
        return [(rows, self.rows_of(rows)) for rows in record_rows(self.lengths)]

    def of_record(self, rows: slice, columns: FloatArray) -> FloatArray:
        """Those of one record, (n_samples, n_outputs, k), by its rows of the residuals."""
        _, q, k = columns.shape
        felt = columns.any(axis=(0, 1))
        whole = np.zeros((q * int(self.kept[rows].sum()), k))
        order = len(self.model.coefficients)
        flat = np.ascontiguousarray(columns[..., felt]).reshape(len(columns) * q, -1)
        past = sliding_window_view(flat, (order + 1) * q, axis=0)[::q].swapaxes(1, 2)
        white: FloatArray = (self._filter @ past)[self.kept[rows][order:]]
        whole[:, felt] = white.reshape(len(whole), -1)
        return whole

    def back(self, rows: slice, white: FloatArray) -> FloatArray:
        """Of columns' products with whitened ones (n_rows, k) what these are with any, of a record.

        Its transpose: (n_samples * n_outputs, k), by the record's rows of the residuals.
        """
        q, order = self.n_outputs, len(self.model.coefficients)
        kept = self.kept[rows]
        whole = np.zeros((len(kept), white.shape[1], q))
        whole[kept] = white[self.rows_of(rows)].reshape(-1, q, white.shape[1]).swapaxes(1, 2)
        pieces = whole[order:] @ self._filter  # (n_samples - order, k, (order + 1) q)
        back = np.zeros_like(whole)
        for lag in range(order + 1):
            back[lag : lag + len(pieces)] += pieces[..., lag * q : (lag + 1) * q]
        flat: FloatArray = back.swapaxes(1, 2).reshape(len(kept) * q, -1)
        return flat

    def rows_of(self, rows: slice) -> slice:
        """Rows of the whitened columns of one record, by its rows of the residuals."""
        first = int(self.kept[: rows.start].sum())
        count = int(self.kept[rows].sum())
        return slice(self.n_outputs * first, self.n_outputs * (first + count))


def colour_about_line(
    residual: FloatArray, seen: BoolArray, measured: BoolArray, lengths: tuple[int, ...]
) -> Autoregression:
    """Colour of residuals (n, q) about offset and drift, of outputs that forget soon enough.

    These are no colour: an autoregression would take them for a memory without end, and
    whitening would erase them. Of noise that is nearly as slow as a record they are part. Each
    record has a line of its own: what is off in one of several is no slow noise of all.
    """
    line = np.zeros_like(residual)
    for rows in record_rows(lengths):
        for j in np.flatnonzero(measured[rows].any(axis=0)):
            at = rows.start + np.flatnonzero(measured[rows, j])
            time = at - at.mean()
            slope = (time @ residual[at, j]) / max(float(time @ time), 1.0)
            line[at, j] = residual[at, j].mean() + slope * time
    centred = residual - line
    model = colour(centred, seen, lengths)
    soon = _FORGETS * longest_memory(model, np.mean(centred**2, axis=0)) <= min(lengths)
    return model if soon.all() else colour(residual - np.where(soon, line, 0.0), seen, lengths)


def _gradient(local: Sensitivity, estimate: Estimate) -> FloatArray:
    """Change of a quantity with each coordinate of the slopes, (n_free,)."""
    space = local.objective.space
    if estimate.combination is None:
        by_parameters = np.eye(len(space.names))[space.names.index(estimate.name)]
    else:
        values = named_values(space, local.chromosome)
        by_parameters = free_gradient(estimate.combination, space, values)
    gradient: FloatArray = by_parameters * local.increments
    return gradient


def describe(findings: Iterable[Finding]) -> list[str]:
    """Findings in a few words each."""
    return [description(finding) for finding in findings]


_WORDS = {
    "delay": "{name} is logged {amplitude:.3g} s {late}",
    "filter": "{name} is logged through a filter of {amplitude:.3g} s",
    "lag": "{name} acts with a lag of {amplitude:.3g} s",
    "play": "{name} acts through play (hysteresis) of {amplitude:.3g} {unit}",
    "offset": "{name} is {amplitude:.3g} {unit} off{instead}",
    "drift": "{name} drifts by {amplitude:.3g} {unit} from a record's first sample on{instead}",
    "noise": "{name} is logged with noise of {amplitude:.2g} {unit}, which has not acted",
    "saturation": "{name} saturates near its largest values",
    "exchange": "{name} have changed places in the log",
}


def description(finding: Finding) -> str:
    """A finding in a few words."""
    amplitude, unit = finding.amplitude, "" if finding.unit == "1" else finding.unit
    if finding.kind == "variant":
        return finding.name
    if finding.term is not None:
        return _term_text(finding.term)
    if finding.kind == "disturbance":
        return f"a slow signal in d{finding.name}/dt that nobody measured"
    assert amplitude is not None
    if finding.kind == "change":
        change = f"{100.0 * amplitude:+.{0 if abs(amplitude) >= 0.01 else 2}f} % of its value"
        return f"{finding.name} changes by {change} from a record's first to last sample"
    if finding.kind == "gain":
        times = f"is {1.0 + amplitude:.3g} times what"
        is_what = "has the opposite sign of what" if finding.turned_round else times
        return f"{finding.name} {is_what} the model has"
    early = "early, or acts so much later" if finding.of_input else "early, or its inputs so late"
    late = "late" if amplitude > 0.0 else early
    instead = ", or something not measured acts like it" if finding.of_input else ""
    text = _WORDS[finding.kind]
    size = abs(amplitude) if finding.kind == "delay" else amplitude
    return (
        text.format(name=finding.name, late=late, amplitude=size, unit=unit, instead=instead)
        .replace("  ", " ")
        .strip()
    )


def _term_text(term: AddedTerm) -> str:
    """A term in a few words."""
    equation = f"d{term.equation}/dt"
    if term.shape == "stribeck":
        return (
            f"a term in {term.of} near its zero in {equation}, like friction that is larger near "
            "standstill (Stribeck)"
        )
    if term.shape == "sign" and term.of == term.equation and term.centre == 0.0:
        return f"a term in the sign of {term.of} in {equation}, like dry friction"
    return f"a term in {term.of} ({term.shape}) in {equation}"


def _log(chance: float) -> float:
    return math.log(chance) if chance > 0.0 else -math.inf


__all__ = ["Finding", "ModelError", "Move", "describe", "description", "missing_physics"]
