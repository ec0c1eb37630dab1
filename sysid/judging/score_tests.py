"""Score tests of what a model may lack, and how far it would move the parameters.

With e the residuals at the estimate, S the slopes of the outputs over the parameters, and D the
change of the outputs by a suspect's amplitudes (see ``suspects``), all whitened by the residuals'
autoregression, e is regressed on S alone and on S and D together. Of the part of D that no change
of the parameters makes, r = D - S S+ D, the score r'e is zero in the mean where the suspect is
not there: its square in units of its covariance is a chi-square (the Lagrange multiplier test;
Breusch & Pagan, Review of Economic Studies 47, 1980). The difference of the two regressions'
parameters is the Gauss-Newton step by which the suspect, were it fitted as well, moves them.

What is known beforehand keeps the regression from using what is no freedom: a factor of e of each
parameter, a channel's zero by as much as its calibration left open. The suspect with the smallest
probability is taken into the regression, and the rest asked again.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.free_run import noiseless
from sysid.fitting.means import scatter
from sysid.fitting.objective import Objective
from sysid.judging.cycles import cycle_suspects
from sysid.judging.disturbed import DisturbedRun, of_each
from sysid.judging.findings import Finding, moves_of
from sysid.judging.regression import Regressed, Regression
from sysid.judging.suspects import (
    Suspect,
    bend_suspects,
    change_suspects,
    channel_suspects,
    curve_suspects,
    disturbance_suspects,
    function_suspects,
    head,
    in_single_records,
    likely_noise,
    variant_suspects,
)
from sysid.judging.whitener import Whitener
from sysid.problem.terms import AddedTerm
from sysid.threads import Workers
from sysid.uncertainty import Estimate, Uncertainty
from sysid.uncertainty.colour import record_rows
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    input_noises,
    sensitivity,
    spans,
    zero_errors,
)
from sysid.uncertainty.ties import free_gradient, named_values

_CHANCE = 1e-3  # probability of a finding by chance, all tests together
_SEVERAL = ("variant", "bend", "function", "curve", "disturbance")  # have no single amplitude
_MOST = 5  # findings
_MOST_SAMPLES = 10_000  # that are tested: beyond, what matters has long been significant
_AS_MUCH = 0.95  # of what another explains, that counts as the same
_LIKELY = 8  # suspects that are tested side by side, and again by the colour of what they leave
_TINY = 1e-300
_ITERATIONS = 20  # by which residuals' variances settle
_COMMON = 0.15  # of the windows' jitter, that they may all lie too early or too late
_FEW = 25  # samples for each amplitude, below which what they leave tells no colour
_INEXACT = 1e-2  # of the residuals' deviation, from where a simulation's error shows in them
_TIMES = (0.5, 2.5, 21)  # delays that are tried, in parts of what a small one tells
_REACH = 10.0  # of a term's range in parts of the size that its test found
# Standard deviation of a coordinate before the data: a factor of e; where an end of a range decides
# its value, the data want it elsewhere, and nobody knows where.
_FREEDOM, _UNBOUND = 1.0, 1e6


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
        left = np.sqrt(np.mean(local.residual**2, axis=0))
        self._exact = noiseless(local.objective, chromosome, left)
        if self._exact:
            return
        self._runs = runs = _runs(local)
        noisy = [runs[0].model.input_names[i] for i in np.flatnonzero(records[0].input_noise)]
        channels = list(channel_suspects(runs))
        # Noise of an input makes its gain look smaller, and play takes it off: that is no fault.
        channels = [s for s in channels if s.kind not in ("gain", "play") or s.name not in noisy]
        foreseen = np.concatenate([_foreseen_noise(runs), _simulation_error(runs, local)], axis=2)
        foreseen = foreseen[..., foreseen.any(axis=(0, 1))]
        chance = np.concatenate([_noisy_starts(runs, local), _moved_windows(runs)], axis=2)
        self._tests = _Tests(local, foreseen, chance, _weights(runs, local), runs[0].workers)
        channels += in_single_records([s for s in channels if s.kind != "noise"], runs)
        self._named = [*channels, *variant_suspects(runs)]

    @cached_property
    def functions(self) -> list[Suspect]:
        """Functions in the equations, for which there may be no need."""
        if self._exact:
            return []
        runs = self._runs
        in_equations = [*function_suspects(runs), *cycle_suspects(runs), *bend_suspects(runs)]
        return [*in_equations, *curve_suspects(runs), *disturbance_suspects(runs)]

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


def _moved_windows(runs: Sequence[DisturbedRun]) -> FloatArray:
    """Change (n_rows, n_outputs, 1) by what all windows may lie too early.

    That each is known to within its jitter does not say that they are right in the mean.
    """
    if not any(run.record.jitter.any() for run in runs):
        return np.zeros((sum(run.record.n_samples for run in runs), runs[0].outputs.shape[1], 0))

    def later(run: DisturbedRun) -> FloatArray:
        if not run.record.jitter.size:
            return np.zeros_like(run.outputs)
        return run.over(run.record.windows + _COMMON * run.record.jitter[..., None]) - run.outputs

    return of_each(runs, later)[..., None]


def _weights(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """What each residual counts, (n_rows, n_outputs), by its deviation in parts of the smallest.

    Of a mean over a time that is not well known the deviation is larger where the output changes
    fast (``scatter``). As regressions weigh all alike, a few such means would decide.
    """

    def scattered(run: DisturbedRun) -> FloatArray:
        return scatter(run.record, lambda record: run.over(record.windows))

    pairs = zip(runs, local.objective.scales, strict=True)
    scattering = np.concatenate([scattered(run) / scale**2 for run, scale in pairs])
    if not scattering.any():
        return np.ones(local.residual.shape)
    squares = np.where(local.seen, local.residual**2, 0.0)
    counts = np.maximum(local.seen.sum(axis=0), 1)
    common = np.maximum(squares.sum(axis=0) / counts, _TINY)
    for _ in range(_ITERATIONS):  # until squares are what variances say
        share = np.sum(squares / (common + scattering), axis=0) / counts
        common = np.maximum(common * share, _TINY)
    weights: FloatArray = np.sqrt(common / (common + scattering))
    return weights


class _Tests:
    """Regression of residuals, to which suspects are admitted one after another.

    Columns are (n_residuals, n_outputs, k), in parts of the outputs' scales.
    """

    findings: list[Finding]
    _ends: list[int]
    _estimates: list[Estimate]
    _gradients: FloatArray

    def __init__(
        self,
        local: Sensitivity,
        foreseen: FloatArray,
        chance: FloatArray,
        weights: FloatArray,
        workers: Workers,
    ) -> None:
        """Of changes that are there whatever is missing, (n_residuals, n_outputs, k) each.

        foreseen: of any size. chance: by one standard deviation of what is known to be so large.
        weights: (n_residuals, n_outputs), as of ``_weights``.
        """
        self._workers = workers
        self._local, self._residual = local, -local.residual * weights
        self._scales = np.concatenate(
            [
                np.broadcast_to(scale, (n, len(scale)))
                for scale, n in zip(local.objective.scales, local.lengths, strict=True)
            ]
        )
        self._scales = self._scales / weights
        zeros = [(zero * weights)[..., None] for zero in zero_errors(local)]
        foreseen, chance = (part / self._scales[..., None] for part in (foreseen, chance))
        slopes = local.slopes * weights[..., None]
        self._columns = np.concatenate([slopes, *zeros, chance, foreseen], axis=2)
        on_bound = local.objective.space.on_bound(local.chromosome)
        freedom = np.where(on_bound, _UNBOUND, _FREEDOM)
        self._free = np.concatenate(
            [
                1.0 / (freedom * spans(local.objective, local.chromosome)),
                np.ones(len(zeros) + chance.shape[2]),
                np.zeros(foreseen.shape[2]),
            ]
        )
        self._noises = [
            (rows, noise * weights[rows][..., None]) for rows, noise in input_noises(local)
        ]
        self._regression = self._coloured_by(self._residual)

    def of(self, uncertainty: Uncertainty) -> Self:
        """The same, before any suspect is admitted, of what has intervals."""
        tests = copy(self)
        tests.findings = []
        tests._ends = [self._columns.shape[2]]  # of the columns until each finding
        # Starts of a very long record's parts are nobody's parameters.
        names = self._local.objective.space.names
        estimates = (e for e in uncertainty.determined() if e.combination or e.name in names)
        tests._estimates = [e for e in estimates if e.deviation]
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
            suspect = suspects[surest]
            if suspect.closer is not None:
                suspect, result, residual = self._closer(suspect, result, residual)
                changes[surest] = suspect.changes / self._scales[..., None]
            term = self._term(suspect, changes[surest], residual)
            self.findings.append(self._finding(suspect, result, logs[surest], term))
            size = np.sqrt(np.mean(changes[surest] ** 2, axis=(0, 1)))
            admitted = changes[surest][..., size > 0.0] / size[size > 0.0]
            self._columns = np.concatenate([self._columns, admitted], axis=2)
            self._free = np.concatenate([self._free, np.zeros(admitted.shape[2])])
            self._ends.append(len(self._free))
            self._regression = self._coloured_by(residual)
            left = [i for i in left if i != surest and not suspects[i].same(suspects[surest])]

    def _likeliest(
        self, changes: Sequence[FloatArray], suspects: Sequence[Suspect], left: Sequence[int]
    ) -> dict[int, Regressed]:
        """Tests of the suspects whose probabilities are the smallest, of different ones.

        In order of what the probabilities are at least, until the rest cannot be among them.
        """
        bounds = self._workers.results(
            lambda i: self._regression.least(changes[i], suspects[i].one_sided), left
        )
        least = dict(zip(left, bounds, strict=True))
        order = sorted(left, key=lambda i: least[i])
        tests: dict[int, Regressed] = {}
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
        self, changes: FloatArray, suspect: Suspect, first: Regressed
    ) -> tuple[Regressed, FloatArray]:
        """A test by the colour of what the suspect leaves, and what it leaves.

        Where it is there, the residuals' colour is mostly its own, and whitening hides it. In a
        short record several amplitudes leave a colour that makes them sure, whatever was there.
        """
        residual = self._left(changes, first)
        if np.count_nonzero(first.amplitudes) * _FEW > len(changes):
            return first, residual
        second = self._coloured_by(residual).test(changes, suspect.one_sided)
        if second is None or second.log_p > first.log_p:
            return first, residual
        return second, self._left(changes, second)

    def _as_late(
        self, suspect: Suspect, result: Regressed, residual: FloatArray
    ) -> tuple[FloatArray, Regressed, FloatArray]:
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

    def _closer(
        self, suspect: Suspect, result: Regressed, residual: FloatArray
    ) -> tuple[Suspect, Regressed, FloatArray]:
        """Of a suspect and those beside it the one that explains most, and what it leaves."""
        assert suspect.closer is not None
        regression = self._coloured_by(residual)
        best = suspect, result
        for beside in suspect.closer():
            test = regression.test(beside.changes / self._scales[..., None], suspect.one_sided)
            if test is not None and test.share > best[1].share:
                best = beside, test
        return *best, self._left(best[0].changes / self._scales[..., None], best[1])

    def settled(self) -> tuple[Finding, ...]:
        """The findings, with what each explains by the colour that all of them leave.

        By the colour of what was left before, which others had their part in, it is too little.
        """
        whitening, rests = self._regression.whitening, []
        for end in self._ends:
            columns, free = self._columns[..., :end], self._free[:end]
            rests.append(Regression(whitening, columns, free, self._residual, ()).squares)
        return tuple(
            replace(finding, share=max(1.0 - after / before, 0.0) if before > 0.0 else 0.0)
            for finding, before, after in zip(self.findings, rests, rests[1:], strict=False)
        )

    def _left(self, changes: FloatArray, result: Regressed) -> FloatArray:
        return self._residual - self._columns @ result.coefficients - changes @ result.amplitudes

    def _coloured_by(self, residual: FloatArray) -> Regression:
        whitening = Whitener.of(self._local, residual)
        return Regression(whitening, self._columns, self._free, self._residual, self._noises)

    def _term(
        self, suspect: Suspect, changes: FloatArray, residual: FloatArray
    ) -> AddedTerm | None:
        """The term of a suspect that by itself explains most; residual: what all leave."""
        regression = self._coloured_by(residual)
        if suspect.terms and suspect.terms[0].shape == "sine":
            both = regression.test(changes, False)
            return (
                suspect.terms[0] if both is None else _of_phase(suspect.terms[0], both.amplitudes)
            )
        alone = [
            (result.share, float(np.abs(result.amplitudes[0])), term)
            for k, term in enumerate(suspect.terms)
            if (result := regression.test(changes[..., [k]], False)) is not None
        ]
        if not alone:
            return suspect.terms[0] if suspect.terms else None
        _, size, term = max(alone, key=lambda test: test[0])
        return _with_reach(term, size)

    def _finding(
        self, suspect: Suspect, result: Regressed, log_p: float, term: AddedTerm | None
    ) -> Finding:
        moved = self._gradients @ result.move[: self._gradients.shape[1]]
        several, amplitudes = suspect.kind in _SEVERAL, result.amplitudes
        names = [estimate.name for estimate in self._estimates]
        if suspect.kind == "change" and suspect.name in names:
            # Whatever its mean, it is not that value at either end of a record.
            place = names.index(suspect.name)
            half = 0.5 * float(amplitudes[0]) * self._estimates[place].value
            moved[place] = max(moved[place], half, key=abs)
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


def _of_phase(sine: AddedTerm, amplitudes: FloatArray) -> AddedTerm:
    """The sine that one and a cosine of these amplitudes make together."""
    phase = float(np.arctan2(amplitudes[1], amplitudes[0]))
    centre = sine.centre - phase * sine.scale
    term = replace(sine, scale=float(f"{sine.scale:.4g}"), centre=float(f"{centre:.3g}"))
    return _with_reach(term, float(np.hypot(*amplitudes)))


def _with_reach(term: AddedTerm, size: float) -> AddedTerm:
    """A term with a range for what its test found to be so large."""
    reach = float(f"{_REACH * size:.1g}") or 1.0
    return replace(term, low=-reach, high=reach)


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
