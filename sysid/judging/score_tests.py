"""Score tests of what a model may lack, and how far it would move the parameters.

With e the residuals at the estimate, S the slopes of the outputs over the parameters, and D the
change of the outputs by a suspect's amplitudes (see ``suspects``), all whitened by the residuals'
autoregression, e is regressed on S alone and on S and D together. Of the part of D that no change
of the parameters makes, r = D - S S+ D, the score r'e is zero in the mean where the suspect is
not there: its square in units of its covariance is a chi-square (the Lagrange multiplier test;
Breusch & Pagan, Review of Economic Studies 47, 1980). What the suspect's amplitudes take out of e,
regressed on S as a fit weighs it, is the Gauss-Newton step by which the suspect, were it fitted as
well, moves the parameters.

What is known beforehand keeps the regression from using what is no freedom: a factor of e of each
parameter, a channel's zero by as much as its calibration left open. The suspect with the smallest
probability is taken into the regression, and the rest asked again.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from sysid.arrays import FloatArray
from sysid.fitting.free_run import noiseless
from sysid.fitting.innovations import Innovations
from sysid.fitting.objective import Objective
from sysid.judging.background import Background, of_filter, of_free_runs, quiet_sensitivity
from sysid.judging.cycles import cycle_suspects
from sysid.judging.disturbed import DisturbedRun
from sysid.judging.feedback import answer_probability, answers
from sysid.judging.findings import (
    MOVED,
    Finding,
    Missing,
    Move,
    Unseen,
    is_of_parameters,
    moves_of,
)
from sysid.judging.hidden import hidden_suspects
from sysid.judging.phrases import sized
from sysid.judging.regression import Regressed, Regression
from sysid.judging.suspects import (
    Suspect,
    bend_suspects,
    change_suspects,
    channel_suspects,
    curve_suspects,
    disturbance_suspects,
    fixed_suspects,
    function_suspects,
    head,
    in_single_records,
    rest_suspects,
    variant_suspects,
)
from sysid.judging.unseen import Possibility, possibilities
from sysid.judging.whitener import Whitener
from sysid.problem.data import of_one_rate
from sysid.problem.terms import AddedTerm
from sysid.threads import Workers
from sysid.uncertainty import Estimate, Uncertainty
from sysid.uncertainty.colour import Autoregression, colour, fast_colour
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    sensitivity,
    spans,
)
from sysid.uncertainty.ties import coded_gradient

_BY_CHANCE = 1e-3
_LOG_CHANCE = np.log(_BY_CHANCE)  # of the probability of a finding by chance, all tests together
_LOG_SURE = np.log(1e-9)  # from where on it does not matter how small it is
# Have no single amplitude.
_SEVERAL = ("variant", "bend", "function", "curve", "disturbance", "rest")
_SLOW = ("delay", "filter", "lag")
_SCALES = ("gain", "offset", "drift")  # of a channel
_MOST = 5  # findings
# A difference of Schwarz's criterion that is very strong evidence.
_STRONG = 10.0
_MOST_SAMPLES = 10_000  # that are tested: beyond, what matters has long been significant
_AS_MUCH = 0.95  # of what another explains, that counts as the same
_HALF = 0.5  # of the residuals' squares, which other equations at rest leave at most, to be named
# Times an output's squares, more than which a fit leaves by nothing that is there. Where samples
# are lost in between, whitened residuals do not tell what is slow.
_WORSE = 2.0
# Of what one explains, up to which what another does differs from it and is the same, or nearly.
_SAME, _NEARLY_SAME = 0.1, 0.7
_AS_LATE = 0.8  # of what one explains that is early, that counts for as much where it is late
_LIKELY = 8  # suspects that are tested side by side, and again by the colour of what they leave
_FEW = 25  # samples for each amplitude, below which what they leave tells no colour
_TIMES = (0.5, 2.5, 21)  # delays that are tried, in parts of what a small one tells
# Change from first to last of what is nowhere below zero, in parts of its mean: 2, 1 for chance.
_EMPTIED = 3.0
_EXACT = 1e-3  # share by which a gain may be off: an angle of many turns may tell far less
_LEAST = 1e-6  # error of an output in parts of the largest, below which it weighs no more
_FLAT = 0.999  # of what the best size of a delay explains, that is as good
_WHOLE = 0.2  # share by which a mean may seem to be longer or shorter than it is
_NEARLY = 0.3  # of what the likeliest shape of a function explains, that a fit may turn round
_SEEN = 4.2  # deviations of an amplitude by which it is found, as chance and number of tests ask
# Deviations by which something unseen moves an estimate at least, to be told: five half widths; and
# part by which it differs from what a parameter does, or it is that.
_HIDDEN, _THE_SAME = 10.0, 1e-6
_REACH = 10.0  # of a term's range in parts of the size that its test found
# Standard deviation of a coordinate before the data: a factor of e; where an end of a range decides
# its value, the data want it elsewhere, and nobody knows where.
_FREEDOM, _UNBOUND = 1.0, 1e6


def missing_physics(
    objective: Objective, chromosome: FloatArray, uncertainty: Uncertainty
) -> Missing:
    """What the model lacks by the records of an objective at its minimum.

    Faults of channels and the model's variants are tried before functions in the equations.
    Raises ModelError where the free run at the chromosome fails.
    """
    return ScoreTests(objective, chromosome).missing(uncertainty)


class ScoreTests:
    """Tests at a minimum, (n_free,), with all that they take but the parameters' intervals.

    objective: of the free run's errors, or whose ``free_run`` is; where a filter averages its
    inputs, of innovations. Raises ModelError where the free run fails.
    """

    def __init__(self, objective: Objective, chromosome: FloatArray) -> None:
        records = head(objective.records, _MOST_SAMPLES)
        filtered = isinstance(objective, Innovations) and objective.quiet
        tested = objective if filtered else objective.free_run
        slopes = sensitivity if filtered else quiet_sensitivity
        local = slopes(tested.on(records), chromosome)
        left = np.sqrt(np.mean(local.residual**2, axis=0))
        self._exact = not filtered and noiseless(local.objective, chromosome, left)
        if self._exact:
            return
        held = of_filter(local) if filtered else of_free_runs(local, records)
        local, runs, background = held
        self._runs, self._tests = runs, _Tests(local, background, runs[0].workers)
        channels = list(channel_suspects(runs))
        self._answered, self._answering = self._tests, self._tests.answering(runs, channels)
        if self._answering:
            # What an input answers at once goes with what it would do if it were late.
            q, lengths = local.residual.shape[1], local.lengths
            signals = np.concatenate([run.measured for run in runs])
            places = map(runs[0].model.input_names.index, self._answering)
            later = [answers(signals[:, i], lengths, q) for i in places]
            foreseen = np.concatenate([background.foreseen, *later], axis=2)
            background = replace(background, foreseen=foreseen)
            self._tests = _Tests(local, background, runs[0].workers)
        noisy = [runs[0].model.input_names[i] for i in np.flatnonzero(records[0].input_noise)]
        # Noise of an input makes its gain look smaller, and play takes it off: that is no fault.
        # Of averages the noise left is as slow as what a delay changes in them.
        of_noise = ("gain", "play", *(_SLOW if filtered else ()))
        channels = [s for s in channels if s.kind not in of_noise or s.name not in noisy]
        channels += in_single_records([s for s in channels if s.kind != "noise"], runs)
        held_values = fixed_suspects(runs, _fixed(objective))
        self._named = [*channels, *held_values, *variant_suspects(runs)]

    @cached_property
    def suspicious(self) -> bool:
        """Whether anything stands out that can be tested without intervals."""
        if self._exact:
            return False
        return any(map(self._tests.are_significant, (self._named, self._functions)))

    def missing(self, uncertainty: Uncertainty) -> Missing:
        """What the model lacks, and how far it moves what has intervals."""
        if self._exact:
            return Missing()
        findings = self._significant(uncertainty)
        if any(finding.counts for finding in findings):
            return Missing(findings)
        tests = self._answered.of(uncertainty)
        feedback = tests.feedback(self._answering)
        # What an input answers later looks as if it were late.
        rest = (f for f in findings if not (self._answering and f.comes_late))
        unseen = () if feedback else tests.unseen(possibilities(self._runs, self._named))
        return Missing((*feedback, *rest), unseen)

    def _significant(self, uncertainty: Uncertainty) -> tuple[Finding, ...]:
        """What is there by more than chance."""
        names, tests = self._runs[0].model.parameter_names, self._tests.of(uncertainty)
        alone = [e.name for e in uncertainty.determined() if e.name in names]
        changing = [*change_suspects(self._runs, alone)]
        # Among more suspects what is left to chance by itself is so all the more.
        if not self.suspicious and not tests.are_significant(changing):
            return ()
        at_rest = list(rest_suspects(self._runs))
        if at_rest and tests.leads([*self._named, *changing, *self._functions], at_rest):
            tests.admit(at_rest, most=1)
            return tests.settled()  # what else is found is of the wrong equations
        named = [*self._named, *changing]
        tests.admit(named)
        if any(finding.kind == "variant" or finding.explains for finding in tests.findings):
            return tests.settled()
        tests.admit(self._functions)
        # Beside what swings, or follows, a line's guess of it leaves what looks like anything.
        hidden = self._beginning(self._hidden, uncertainty)
        beside = self._in_place_of(tests.findings, named)
        rival = min([hidden, self._beginning(beside, uncertainty)], key=lambda each: each.criterion)
        if rival.criterion > tests.criterion - _STRONG:
            return tests.settled()
        if rival is not hidden:
            rival.admit([*named, *self._functions])
        return rival.settled()

    def _beginning(self, suspects: Sequence[Suspect], uncertainty: Uncertainty) -> "_Tests":
        """Tests that begin with the surest of some suspects."""
        tests = self._tests.of(uncertainty)
        tests.admit(suspects, most=1)
        return tests

    def _in_place_of(self, findings: Sequence[Finding], named: Sequence[Suspect]) -> list[Suspect]:
        """Functions for which a channel's fault that was found first may stand, if one was.

        Not of an input that has the fault, which stand for it, nor an output's curve, which is a
        fault as well, nor a signal that may be anything.
        """
        if not findings or findings[0].kind not in {suspect.kind for suspect in named}:
            return []
        stands = {findings[0].name} if findings[0].of_input else set()
        return [
            suspect
            for suspect in self._functions
            if stands.isdisjoint(term.of for term in suspect.terms)
            and suspect.kind not in ("curve", "disturbance")
        ]

    @cached_property
    def _hidden(self) -> list[Suspect]:
        """What hangs on a state, asked for only where something is left."""
        return list(hidden_suspects(self._runs))

    @cached_property
    def _functions(self) -> list[Suspect]:
        """Functions in the equations, for which there may be no need."""
        runs = self._runs
        in_equations = [*function_suspects(runs), *cycle_suspects(runs), *bend_suspects(runs)]
        return [*in_equations, *curve_suspects(runs), *disturbance_suspects(runs)]


class _Tests:
    """Regression of residuals, to which suspects are admitted one after another.

    Columns are (n_residuals, n_outputs, k), in parts of the outputs' scales. criterion: Schwarz's,
    of what the first finding leaves.
    """

    findings: list[Finding]
    criterion: float
    _ends: list[int]
    _estimates: list[Estimate]
    _gradients: FloatArray

    def __init__(self, local: Sensitivity, background: Background, workers: Workers) -> None:
        self._workers = workers
        weights = background.weights
        self._local, self._residual = local, -local.residual * weights
        self._scales = local.objective.scales_of_each / weights
        foreseen, chance = (
            part / self._scales[..., None] for part in (background.foreseen, background.chance)
        )
        self._columns = np.concatenate(
            [local.slopes * weights[..., None], chance, foreseen], axis=2
        )
        on_bound = local.objective.space.on_bound(local.chromosome)
        freedom = np.where(on_bound, _UNBOUND, _FREEDOM)
        self._free = np.concatenate(
            [
                1.0 / (freedom * spans(local.objective, local.chromosome)),
                np.ones(chance.shape[2]),
                np.zeros(foreseen.shape[2]),
            ]
        )
        self._noises = [
            (rows, noise * weights[rows][..., None]) for rows, noise in background.noises
        ]
        self._recolour(self._residual)

    def of(self, uncertainty: Uncertainty) -> Self:
        """The same, before any suspect is admitted, of what has intervals."""
        tests = copy(self)
        tests.findings = []
        tests._ends = [self._columns.shape[2]]  # of the columns until each finding
        tests.criterion = math.inf
        # Starts of a very long record's parts are nobody's parameters.
        names = self._local.objective.space.names
        estimates = (e for e in uncertainty.determined() if e.combination or e.name in names)
        tests._estimates = [e for e in estimates if e.deviation]
        gradients = [_gradient(self._local, e) for e in tests._estimates]
        tests._gradients = np.array(gradients).reshape(-1, self._local.slopes.shape[2])
        return tests

    def feedback(self, answering: Mapping[str, float]) -> tuple[Finding, ...]:
        """The input that answers what outputs err by, where that has moved an estimate.

        answering: probabilities as of ``answering``.
        """
        if not answering:
            return ()
        coefficients = self._regression.coefficients
        moved = self._gradients @ coefficients[: self._gradients.shape[1]]
        moves = tuple(map(self._within_limits, moves_of(self._estimates, moved.tolist())))
        if not moves or abs(moves[0].deviations) < MOVED:
            return ()
        name = min(answering, key=lambda each: answering[each])
        return (Finding("feedback", name, "", 1.0, answering[name], 0.0, moves, of_input=True),)

    def unseen(self, possibilities: Iterable[Possibility]) -> tuple[Unseen, ...]:
        """What may be there and would not be seen, and moves an estimate farthest, farthest first.

        Each moves one farther than those before it do.
        """
        if self._local.corrects:  # what its innovations take up is not known
            return ()
        every = [unseen for p in possibilities if (unseen := self._unseen(p)) is not None]
        every.sort(key=lambda unseen: -unseen.farthest)
        farthest, chosen = dict[str, float](), list[Unseen]()
        for unseen in every:
            sizes = {move.quantity.name: abs(move.deviations) for move in unseen.moves}
            if any(size > max(_HIDDEN, farthest.get(n, 0.0)) for n, size in sizes.items()):
                chosen.append(unseen)
            farthest |= {n: max(size, farthest.get(n, 0.0)) for n, size in sizes.items()}
        return tuple(chosen)

    def _unseen(self, possibility: Possibility) -> Unseen | None:
        """What a possibility would move while it is not seen; None of what a parameter does."""
        changes = possibility.suspect.changes / self._scales[..., None]
        flat, slopes = changes.ravel(), self._local.slopes.reshape(changes.size, -1)
        sizes = np.linalg.norm(slopes, axis=0) * np.linalg.norm(flat)
        alike = np.abs(flat @ slopes) > (1.0 - _THE_SAME) * np.where(sizes > 0.0, sizes, np.inf)
        if not flat.any() or alike.any():
            return None
        amplitude = min(possibility.usual, _SEEN * self._regression.deviation(changes))
        moved = self._moved_by(amplitude * changes[..., 0])
        every = map(self._within_limits, moves_of(self._estimates, moved.tolist()))
        model = self._local.objective.simulator.model
        moves = tuple(move for move in every if is_of_parameters(move.quantity, model))
        size = sized(amplitude * possibility.size, possibility.unit, 2)
        return Unseen(possibility.words.format(size=size), moves, possibility.cure)

    def answering(
        self, runs: Sequence[DisturbedRun], channels: Sequence[Suspect]
    ) -> dict[str, float]:
        """Inputs that answer what outputs err by, with the probabilities that this is chance.

        Not those whose noise outputs err by: what is logged next tells more of it, and looks alike.
        """
        planned = all(run.record.planned for run in runs)
        if planned or self._local.corrects:  # a filter's innovations are new
            return {}
        rest = self._residual - self._columns @ self._regression.coefficients
        white = self._regression.whitening.in_time(np.where(self._local.seen, rest, 0.0))
        signals = np.concatenate([run.measured for run in runs])
        exact = np.flatnonzero(runs[0].record.input_noise == 0.0).tolist()
        lengths, answering = self._local.lengths, dict[str, float]()
        for i, name in ((i, runs[0].model.input_names[i]) for i in exact):
            chance = len(exact) * answer_probability(white, signals[:, i], lengths)
            noises = [s for s in channels if s.kind == "noise" and s.name == name]
            if chance < _BY_CHANCE and not self.are_significant(noises):
                answering[name] = chance
        return answering

    def are_significant(self, suspects: Sequence[Suspect]) -> bool:
        """Whether any of the suspects is there by more than chance, before any is admitted."""
        changes, left, tests = self._asked(suspects)
        results = self._tested(changes, suspects, left)
        return any(result.log_p + np.log(tests) < _LOG_CHANCE for result, _ in results.values())

    def leads(self, suspects: Sequence[Suspect], before: Sequence[Suspect]) -> bool:
        """Whether one of those before is there, and leaves least of all, and little, of the errors.

        Of errors that are large, and by their squares as they are: each whitens them by a colour
        of its own.
        """
        changes, left, tests = self._asked([*before, *suspects])
        first = [i for i in left if i < len(before)]
        results = self._tested(changes, before, first)
        sure = [e for r, e in results.values() if r.log_p + np.log(tests) < _LOG_CHANCE]
        least = min(map(self._squares, sure), default=1.0)
        if least > _HALF:
            return False
        rest = self._tested(changes, [*before, *suspects], [i for i in left if i not in first])
        return least < min((self._squares(e) for _, e in rest.values()), default=1.0)

    def _squares(self, residual: FloatArray) -> float:
        """Squares of what is left, in the mean of the outputs, in parts of the residuals'."""
        return float(np.mean((residual / self._errors) ** 2))

    def admit(self, suspects: Sequence[Suspect], most: int = _MOST) -> None:
        """Admit the suspects that are there by more than chance, each given those before it."""
        changes, left, tests = self._asked(suspects)
        while left and len(self.findings) < most:
            results = self._tested(changes, suspects, left)
            logs = {i: result.log_p + np.log(tests) for i, (result, _) in results.items()}
            likely = [i for i in logs if logs[i] < _LOG_CHANCE]
            if not likely:
                return
            before = self._left_by_fit(self._of_admitted(self._regression.coefficients))
            significant = [
                i
                for i in likely
                if self._is_possible(suspects[i], results[i][0])
                and not self._is_worse(changes[i], results[i][0], before)
            ]
            if not significant:
                return
            surest = _surest(suspects, {i: (logs[i], results[i][0]) for i in significant})
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
            if suspect.mean is not None:
                late = changes[surest], result, residual
                suspect, changes[surest], result, residual = self._as_mean(suspect, *late)
            if suspect.closer is not None:
                suspect, result, residual = self._closer(suspect, result, residual)
                changes[surest] = suspect.changes / self._scales[..., None]
            alike = [
                i
                for i in significant
                if i != surest and suspects[i].acts_like(suspect) and not suspects[i].repeats
            ]
            terms, alone = self._terms(suspect, changes[surest], residual)
            for i in alike:
                terms += self._terms(suspects[i], changes[i], results[i][1])[0]
            # Of what shape a function is hardly shows, and decides what it moves.
            shapes = [
                self._moved(changes[i], results[i][0])
                for i in significant
                if i != surest and suspects[i].shares_place(suspect)
            ]
            same, instead = self._lookalikes(surest, suspects, significant, results, residual)
            farther = {i: self._moved(changes[i], results[i][0]) for i in instead}
            moves = [self._moved(changes[surest], result), *alone, *shapes, *farther.values()]
            finding = self._finding(suspect, result, moves, logs[surest], terms)
            others = [
                self._finding(suspects[i], results[i][0], [moved], logs[i], ())
                for i, moved in farther.items()
            ]
            finding = replace(finding, alike=tuple(same), instead=tuple(others))
            self.findings.append(finding)
            size = np.sqrt(np.mean(changes[surest] ** 2, axis=(0, 1)))
            admitted = changes[surest][..., size > 0.0] / size[size > 0.0]
            self._columns = np.concatenate([self._columns, admitted], axis=2)
            self._free = np.concatenate([self._free, np.zeros(admitted.shape[2])])
            self._ends.append(len(self._free))
            self._recolour(residual)
            if len(self.findings) == 1:
                amplitudes = self._ends[1] - self._ends[0]
                self.criterion = self._schwarz + math.log(len(self._residual)) * amplitudes
            left = [i for i in left if i != surest and not suspects[i].same(suspects[surest])]

    def _lookalikes(
        self,
        surest: int,
        suspects: Sequence[Suspect],
        significant: Sequence[int],
        results: Mapping[int, tuple[Regressed, FloatArray]],
        residual: FloatArray,
    ) -> tuple[list[str], list[int]]:
        """Channels of which the surest suspect's fault is the same, and places of nearly the same.

        A sensor that sees another channel looks much like one that is late, and moves more.
        """
        kind, same, nearly = suspects[surest].kind, list[str](), list[int]()
        for i in (i for i in significant if i != surest):
            alike, left = suspects[i].kind == kind, results[i][1]
            if alike and kind in _SCALES and self._leave_the_same(left, residual, _SAME):
                same.append(suspects[i].name)
            if {suspects[i].kind, kind} == {"crosstalk", "delay"} and self._leave_the_same(
                left, residual, _NEARLY_SAME
            ):
                nearly.append(i)
        return same, nearly

    def _leave_the_same(self, residual: FloatArray, another: FloatArray, tolerance: float) -> bool:
        """Whether two suspects, by what each leaves, (n, n_outputs), explain nearly the same.

        tolerance: of what the second explains, up to which they differ.
        """
        before = self._residual - self._columns @ self._regression.coefficients
        difference, explained = residual - another, before - another
        return self._squares(difference) < tolerance**2 * self._squares(explained)

    def _is_worse(self, changes: FloatArray, result: Regressed, before: FloatArray) -> bool:
        """Whether a fit with a suspect leaves an output larger errors than it had.

        Nothing that is there does, whatever the residuals' colour makes of it. before: squares that
        are left without it, (n_outputs,).
        """
        taken = changes @ result.amplitudes + self._of_admitted(result.coefficients)
        return bool(np.any(self._left_by_fit(taken) > _WORSE * before))

    def _of_admitted(self, coefficients: FloatArray) -> FloatArray:
        """What the suspects that are admitted take out, by coefficients of all columns."""
        admitted = slice(self._ends[0], None)
        taken: FloatArray = self._columns[..., admitted] @ coefficients[admitted]
        return taken

    def _is_possible(self, suspect: Suspect, result: Regressed) -> bool:
        """Whether it is a fault by its size.

        A gain is off by more than what no sensor holds, crosstalk is little, and a parameter that
        changes stays above zero where physics asks for that.
        """
        if suspect.kind == "gain":
            return abs(float(result.amplitudes[0])) > _EXACT
        if suspect.kind == "crosstalk":
            return abs(float(result.amplitudes[0])) < suspect.most
        limits = self._limits.get(suspect.name) if suspect.kind == "change" else None
        return limits is None or limits[0] < 0.0 or abs(result.amplitudes[0]) < _EMPTIED

    @cached_property
    def _limits(self) -> dict[str, tuple[float, float]]:
        """What physics allows of each parameter, by name."""
        parameters = self._local.objective.space.parameters
        return {p.name: (p.minimum, p.maximum) for p in parameters}

    def _asked(self, suspects: Sequence[Suspect]) -> tuple[list[FloatArray], list[int], int]:
        """Changes by each suspect, those that change anything, and how many tests these are."""
        changes = [s.changes / self._scales[..., None] for s in suspects]
        left = [i for i, change in enumerate(changes) if np.any(change)]
        # A channel that is late by this or that is one suspect.
        late = {(suspects[i].kind, suspects[i].name) for i in left if suspects[i].late is not None}
        return changes, left, len(late) + sum(suspects[i].late is None for i in left)

    def _tested(
        self, changes: Sequence[FloatArray], suspects: Sequence[Suspect], left: Sequence[int]
    ) -> dict[int, tuple[Regressed, FloatArray]]:
        """Tests of the likeliest suspects, and what each leaves."""
        first = self._likeliest(changes, suspects, left)
        again = self._workers.results(
            lambda task: self._again(*task),
            [(changes[i], suspects[i], test) for i, test in first.items()],
        )
        return dict(zip(first, again, strict=True))

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
        left = self._left(changes, second)
        likely = self._log_likely(left, int(np.count_nonzero(second.amplitudes)))
        if likely < _LOG_SURE:
            return second, left
        if likely > first.log_p:
            return first, residual
        return replace(second, log_p=max(second.log_p, likely)), left

    def _log_likely(self, left: FloatArray, freedom: int) -> float:
        """Logarithm of the probability that noise is by chance so much likelier without a suspect.

        left: what that leaves. Each by its own colour, with lines and all: the suspect may be
        what slow noise does in a record, and no slow noise is left of it then.
        """
        ratio = self._deviance - self._colour_of(left).deviance
        chance = float(chdtrc(freedom, max(ratio, 0.0)))
        return math.log(chance) if chance > 0.0 else -math.inf

    def _colour_of(self, residual: FloatArray) -> Autoregression:
        """Colour of residuals with all that is straight in them."""
        local, of = self._local, colour if self._slow else fast_colour
        counted = local.seen & (local.objective.weights > 0.0)
        return of(np.where(counted, residual, 0.0), local.seen, local.lengths)

    def _as_late(
        self, suspect: Suspect, result: Regressed, residual: FloatArray
    ) -> tuple[FloatArray, Regressed, FloatArray]:
        """Changes, test and what is left of a delay as large as explains most of the residuals.

        Of sizes that explain about as much that of which no more and no less than all is there.
        """
        assert suspect.late is not None
        regression = self._coloured_by(residual)
        delays = (float(result.amplitudes[0]) * np.linspace(*_TIMES)).tolist()
        late = [suspect.late(delay) / self._scales[..., None] for delay in delays]
        tests = self._workers.results(lambda each: regression.test(each, suspect.one_sided), late)
        sizes = [
            (delay, changes, test)
            for delay, changes, test in zip(delays, late, tests, strict=True)
            if test is not None
        ]
        if not sizes:
            return suspect.changes / self._scales[..., None], result, residual
        enough = _FLAT * max(test.share for _, _, test in sizes)
        alike = [each for each in sizes if each[2].share >= enough]
        delay, changes, test = min(alike, key=lambda each: abs(float(each[2].amplitudes[0]) - 1.0))
        left = self._left(changes, test)
        # By the second, so that the amplitude is the delay.
        changes = changes * test.amplitudes / delay
        return changes, replace(test, amplitudes=np.array([delay])), left

    def _as_mean(
        self, suspect: Suspect, changes: FloatArray, result: Regressed, residual: FloatArray
    ) -> tuple[Suspect, FloatArray, Regressed, FloatArray]:
        """Of an output that is late the same as a mean, where being whole it explains as much."""
        assert suspect.mean is not None
        regression, mean = self._coloured_by(residual), suspect.mean()
        averaged = mean.changes / self._scales[..., None]
        late, test = (regression.test(each, False) for each in (changes, averaged))
        if test is None or (late is not None and test.share < _AS_MUCH * late.share):
            return suspect, changes, result, residual
        records = self._local.objective.records
        time = records[0].dt
        # Of logs of several rates no one time is that since the sample before.
        alike = of_one_rate(records)
        if not alike or abs(float(test.amplitudes[0]) / time - 1.0) > _WHOLE:
            return suspect, changes, result, residual
        left = self._left(averaged, test)
        return mean, averaged, replace(test, amplitudes=np.array([time])), left

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

    def _recolour(self, residual: FloatArray) -> None:
        """Take the colour of what the columns leave, or leave nearly, for that of the noise."""
        self._slow = True
        self._regression = self._coloured_by(residual)
        rest = self._colour_of(self._residual - self._columns @ self._regression.coefficients)
        self._deviance, self._schwarz = rest.deviance, rest.criterion
        # What a suspect explains may be slow; what it leaves is not where nothing is.
        self._slow = bool(rest.slow or self._regression.whitening.model.slow)

    def _coloured_by(self, residual: FloatArray) -> Regression:
        whitening = Whitener.of(self._local, residual, self._slow)
        return Regression(whitening, self._columns, self._free, self._residual, self._noises)

    def _terms(
        self, suspect: Suspect, changes: FloatArray, residual: FloatArray
    ) -> tuple[list[AddedTerm], list[FloatArray]]:
        """Terms of a suspect that by themselves explain, the most first, and what each moves.

        residual: what all leave. Those of which a step tells no more than that a fit may well end
        with them.
        """
        regression = self._coloured_by(residual)
        if suspect.terms and suspect.terms[0].shape == "sine":
            both = regression.test(changes, False)
            first = suspect.terms[0]
            return [first if both is None else _of_phase(first, both.amplitudes)], []
        columns = [changes[..., [k]] for k in range(len(suspect.terms))]
        tests = [regression.test(column, False) for column in columns]
        alone = [
            (test, term, column)
            for test, term, column in zip(tests, suspect.terms, columns, strict=False)
            if test is not None
        ]
        if not alone:
            return list(suspect.terms[:1]), []
        alone.sort(key=lambda each: -each[0].share)
        alone = [each for each in alone if each[0].share > _NEARLY * alone[0][0].share]
        return (
            [_with_reach(term, float(np.abs(test.amplitudes[0]))) for test, term, _ in alone],
            [self._moved(column, test) for test, _, column in alone],
        )

    def _moved(self, changes: FloatArray, result: Regressed) -> FloatArray:
        """By how much each estimate moves where a fit, by its own weights, has a suspect as well.

        Not by the whitened residuals': these may weigh what the estimate hardly counts.
        """
        return self._moved_by(changes @ result.amplitudes + self._of_admitted(result.move))

    def _moved_by(self, taken: FloatArray) -> FloatArray:
        """By how much each estimate moves where a fit takes such changes out of the residuals."""
        basis, triangle = self._fitted
        within = basis[: taken.size].T @ (taken / self._errors).ravel()
        moved: FloatArray = self._gradients @ -solve_triangular(triangle, within)
        return moved

    def _left_by_fit(self, taken: FloatArray) -> FloatArray:
        """Squares of each output, (n_outputs,), left by a fit that takes such changes out."""
        basis, _ = self._fitted
        basis = basis[: taken.size]
        target = ((self._residual - taken) / self._errors).ravel()
        left = (target - basis @ (basis.T @ target)).reshape(taken.shape)
        squares: FloatArray = np.sum(left**2, axis=0)
        return squares

    @cached_property
    def _errors(self) -> FloatArray:
        """Root mean square of each output's residuals, (n_outputs,), by which a fit weighs."""
        rms = np.sqrt(np.mean(self._residual**2, axis=0))
        errors: FloatArray = np.maximum(rms, _LEAST * rms.max())
        return errors

    @cached_property
    def _fitted(self) -> tuple[FloatArray, FloatArray]:
        """QR factors of the slopes as a fit weighs them, above what is known of each beforehand."""
        count = self._gradients.shape[1]
        slopes = (self._columns[..., :count] / self._errors[:, None]).reshape(-1, count)
        basis, triangle = np.linalg.qr(np.vstack([slopes, np.diag(self._free[:count])]))
        return basis, triangle

    def _finding(
        self,
        suspect: Suspect,
        result: Regressed,
        moves: Sequence[FloatArray],
        log_p: float,
        terms: Sequence[AddedTerm],
    ) -> Finding:
        """Of a suspect by its test, each estimate moved as by whichever moves it farthest."""
        moved = np.array([max(each, key=abs) for each in zip(*moves, strict=True)])
        several, amplitudes = suspect.kind in _SEVERAL, result.amplitudes
        size = float(amplitudes[0]) if suspect.size is None else suspect.size
        names = [estimate.name for estimate in self._estimates]
        if suspect.kind == "change" and suspect.name in names:
            # Whatever its mean, it is not that value at either end of a record.
            place = names.index(suspect.name)
            half = 0.5 * float(amplitudes[0]) * self._estimates[place].value
            moved[place] = max(moved[place], half, key=abs)
        # A line may lead farther than physics allows.
        moves_to = [self._within_limits(move) for move in moves_of(self._estimates, moved.tolist())]
        return Finding(
            suspect.kind,
            suspect.name,
            suspect.unit,
            None if several else size,
            float(np.exp(min(log_p, 0.0))),
            result.share,
            tuple(moves_to),
            next(iter(terms), None),
            suspect.of_input,
            rivals=tuple(terms[1:]),
        )

    def _within_limits(self, move: Move) -> Move:
        low, high = self._limits.get(move.quantity.name, (-np.inf, np.inf))
        value = move.quantity.value
        return replace(move, change=float(np.clip(move.change, low - value, high - value)))


def _fixed(objective: Objective) -> list[str]:
    """Parameters that the user holds at a value, which nothing says is uncertain."""
    space = objective.space
    free = {*space.index, *(tie.index for tie in space.ties)}
    free |= {*np.flatnonzero(objective.given.any(axis=0)).tolist()}
    return [
        parameter.name
        for i, parameter in enumerate(space.model.parameters)
        if i not in free and not parameter.fixed and space.base[i]
    ]


def _surest(suspects: Sequence[Suspect], tests: Mapping[int, tuple[float, Regressed]]) -> int:
    """Place of the surest of suspects, by logarithms of their probabilities and their tests.

    Of probabilities too small for a number what explains more decides. Of a channel's gain and a
    value that a user fixed, where both look the same, it is the value. Nothing is logged before it
    happens: what comes late is surer than what would have to be early by about as much.
    """
    surest = min(log_p for log_p, _ in tests.values())
    alike = [i for i, (log_p, _) in tests.items() if log_p == surest]
    enough = _AS_MUCH * max(tests[i][1].share for i in alike)
    first = next(i for i in alike if tests[i][1].share >= enough)
    if suspects[first].kind == "gain":
        enough = _AS_MUCH * tests[first][1].share
        fixed = [i for i in tests if suspects[i].kind == "fixed" and tests[i][1].share >= enough]
        first = next(iter(fixed), first)
    if not (suspects[first].kind == "delay" and tests[first][1].amplitudes[0] < 0.0):
        return first
    enough = _AS_LATE * tests[first][1].share
    late = [
        i
        for i, (_, test) in tests.items()
        if suspects[i].kind == "delay" and test.amplitudes[0] > 0.0 and test.share >= enough
    ]
    return min([first, *late], key=lambda i: (i == first, tests[i][0]))


def _of_phase(sine: AddedTerm, amplitudes: FloatArray) -> AddedTerm:
    """The sine that one and a cosine of these amplitudes make together, those of a first record."""
    along, across = amplitudes[:2].tolist()
    phase = math.atan2(across, along)
    centre = sine.centre - phase * sine.scale
    term = replace(sine, scale=float(f"{sine.scale:.4g}"), centre=float(f"{centre:.3g}"))
    return _with_reach(term, math.hypot(along, across))


def _with_reach(term: AddedTerm, size: float) -> AddedTerm:
    """A term with a range for what its test found to be so large."""
    reach = float(f"{_REACH * size:.1g}") or 1.0
    return replace(term, low=-reach, high=reach)


def _gradient(local: Sensitivity, estimate: Estimate) -> FloatArray:
    """Change of a quantity with each coordinate of the slopes, (n_free,)."""
    space = local.objective.space
    if estimate.combination is not None:
        return coded_gradient(estimate.combination, space, local.chromosome)
    by_parameters = np.eye(len(space.names))[space.names.index(estimate.name)]
    gradient: FloatArray = by_parameters * local.increments
    return gradient
