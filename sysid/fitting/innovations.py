"""The objective for inputs that are measured with noise.

A free run is driven by the noise n of its inputs, too, so that minimising |y - G (u0 + n)|^2 also
minimises |G n|^2: parameters that damp the noise are preferred to the true ones. Here every error
is divided by the standard deviation that noise gives it, of the inputs as the model passes it on
and of the outputs: sum e_k^2 / s_k. On average it is the number of samples for the true
parameters, and more for all others. For a regression this is Deming's. e_k and s_k are, by
``corrects``,

- off: the error of the free run, and its variance. It asks nothing of the outputs' errors but
  that they are not the inputs'.
- on: the innovation of an extended Kalman filter, and its variance. Their sum is the least that
  white noise of both kinds must have done, min over n of sum n^2 + sum |y - g(u + n)|^2, each in
  parts of its variance. Estimates vary less, and errors of a sensor that are not white move them
  more.

The likelihood of Kristensen, Madsen & Jorgensen ("Parameter estimation in stochastic grey-box
models", Automatica 40, 2004), adds sum log s_k and takes n as independent of the *measured* input.
Of a measured one that is untrue, and the logarithm brings all of the free run's bias back
(docs/decisions/0013-innovations.md). The outputs' noise therefore cannot come from the same sum,
which vanishes as it grows: it is such that the mean of e_k^2 / s_k is one.

Noise of the process is independent of all that is measured. Where there is some, the logarithm
belongs to the sum: without it, parameters that pass on more of that noise would seem better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import comb
from typing import Any, Self, TypeGuard

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.engine.filter_settings import FilterSettings
from sysid.engine.linear_response import LinearResponse
from sysid.engine.simulation import BatchResult, Residuals, Status
from sysid.fitting.averages import coloured, denoised
from sysid.fitting.means import Scatter, each_mean_once, scatter
from sysid.fitting.moves import moved_by
from sysid.fitting.objective import Objective
from sysid.fitting.reactions import with_reactions
from sysid.problem.channels import MEDIAN_OF_NORMAL
from sysid.problem.data import Dataset

_ROUNDS, _STEADY = 30, 1e-4  # of the outputs' noise, and its relative change at the end
_FARTHEST = 2.3  # change of its logarithm that two rounds may foretell
# Noise of an output is not below this share of its free run's error; where it comes near, noise
# of the inputs explains more than there is to explain.
_LEAST_NOISE, _NEAR = 1e-2, 0.1
_LEAST_OF_FILTER = 1e-4
_TENTH, _PART_OF_TENTH = 0.1, 0.15
_BY_CHANCE = 3.0  # deviations
_WHITE = 1.05  # ratio of what third and fifth differences show, below which it is white noise
_TINY = 1e-140  # a deviation whose square is not yet zero
_LEFT = 0.5  # part of an input's noise that averages may leave: with more they cure nothing
_SHOWING = 0.025  # part of an output's peak that inputs' averages may take from it
MISJUDGED = 0.02  # share of an output's innovations, above which a filter may be no judge
# Draws of the inputs' noise that show where equations bend under it, and parts of an innovation's
# deviation from which they do.
_DRAWS, _BENT = 8, 0.1
# Deviations of an innovation that no chance explains: around a bend a filter may have lost the
# states. Part of an output's noise down to which it holds where it has, and share of an output's
# samples above which it is the parameters that are wrong.
_UNLIKELY, _ANEW, _MOSTLY = 8.0, 0.5, 0.5
# Integration steps of a free run that one of a filter may stand for, and by how many deviations of
# any quantity the difference may move it where an answer is at stake.
_FEWER, _FINER, _MOVING = (3.0, 2.0, 1.0), (0.5, 0.25), 0.2
_LEAST_STEPS = 1, 8, 16  # a sample, tried in turn where covariances burst
# Deviations by which parabolas for averaged outputs may move any quantity: intervals count it.
_OFF = 1.5
_FEWEST = 2  # a sample, where a free run takes more
_PART = 0.5  # of a deviation that steps of a free run may move any quantity by
_MANY = 32  # a sample, with which no covariance bursts
_BURST = 0.1  # of the innovations, by which steps of a free run may change them


class Innovations(Objective):
    """As ``Objective``, of innovations scaled to the outputs' own noise.

    noise: (n_outputs,), standard deviations of the outputs in their units. error: (n_outputs,),
    the same of the free run's errors at the chromosome that it began with. corrects: whether
    outputs correct the states. process: (n_states,), noise of the states' rates, in their units
    over the root of a second. scatter: per record, (n_samples, n_outputs), variances of single
    samples beside the noise, by the jitter of their windows; shift: likewise, as of ``Scatter``.
    Where it corrects, the records have each mean over a window once. coarseness: integration steps
    of a free run that one of the filter's stands for; least: of the filter's in a sample. exact:
    whether averages are not of parabolas between samples. trust: per record, (n_samples,
    n_outputs), parts of each innovation that count.
    """

    noise: FloatArray
    scatter: list[FloatArray]
    shift: list[FloatArray]
    error: FloatArray
    corrects: bool
    process: FloatArray
    colour: list[FloatArray]
    quiet: bool
    coarseness: float
    least: int
    exact: bool
    trust: list[FloatArray]

    @classmethod
    def of(
        cls,
        objective: Objective,
        noise: FloatArray,
        *,
        corrects: bool,
        process: FloatArray | None = None,
        quiet: bool = False,
        near: FloatArray | None = None,
    ) -> Self:
        """An objective's counterpart; near: (n_free,), whose free runs tell of the motion."""
        variant = cls.__new__(cls)
        vars(variant).update(vars(objective), slopes_by=None, exact_slopes=False)
        variant.colour = [np.zeros(len(r.input_noise)) for r in objective.records]
        if corrects:
            variant.records = [each_mean_once(record) for record in objective.records]
            seen = [np.isfinite(record.outputs).sum(axis=0) for record in variant.records]
            variant.counts = np.sum(seen, axis=0)
        if near is not None:
            variant.records = variant._reacting(near)
        variant.quiet = quiet
        if quiet:
            parts = [denoised(record) for record in variant.records]
            variant.records, variant.colour = [q.record for q in parts], [q.colour for q in parts]
        variant.noise = variant.error = np.maximum(noise, _TINY)
        variant.scatter, variant.shift = _parts_of(variant._scatters(near))
        variant.trust = _full(variant.records)
        variant.corrects, variant.exact = corrects, False
        variant.coarseness, variant.least = 1.0, 1
        n_states = len(objective.simulator.model.states)
        variant.process = np.zeros(n_states) if process is None else process
        return variant

    @classmethod
    def starting(
        cls,
        objective: Objective,
        chromosome: FloatArray,
        *,
        corrects: bool,
        process: FloatArray | None = None,
    ) -> Self:
        """Its counterpart with the noise that the innovations show at a chromosome, (n_free,)."""
        steps = objective.steps_needed(chromosome[None])[0]
        residual = objective.residuals(chromosome[None], steps).values[..., 0]
        error = objective.in_units(residual)
        settings: dict[str, Any] = {"corrects": corrects, "process": process, "near": chromosome}
        plain = cls.of(objective, error, **settings)._noise_found(chromosome)
        # A filter is best told all; what averages lose of the inputs repeats itself.
        may_average = corrects and _may_average(objective, chromosome, steps, residual)
        if may_average and np.any(plain.bent(chromosome) > MISJUDGED):
            averaged = cls.of(objective, error, quiet=True, **settings)._noise_found(chromosome)
            return averaged.renewed(chromosome).eased(chromosome)
        return plain.eased(chromosome)

    def _noise_found(self, chromosome: FloatArray) -> Self:
        """With the noise that comes of few integration steps at a chromosome, (n_free,)."""
        few = self._with_fewest_steps(chromosome, _MOVING) if self.corrects else self
        return few.settled(chromosome)

    def eased(self, chromosome: FloatArray, moving: float = _MOVING) -> Self:
        """With as little effort as tells the same at a chromosome, (n_free,).

        moving: deviations of any quantity that the difference may move it by.
        Errors of a free run's steps add up over its memory; a filter forgets them, as its outputs
        correct it, and noise covers what is left of them. That outputs are no parabolas between
        samples comes again with the inputs: noise covers it in short records alone.
        """
        if not self.corrects:
            return self
        eased = self._with_fewest_steps(chromosome, moving)
        return eased._with(exact=eased.rings_at(chromosome[None]))

    @property
    def exact_means(self) -> Self:
        """With averages as outputs run between samples."""
        return self._with(exact=True)

    def rings_at(self, chromosomes: FloatArray) -> bool:
        """Whether averages of parabolas move quantities at the one of (n, n_free) that rings most.

        What is exact stays so: parabolas prefer minima at which they do not.
        """
        if self.exact or not any(record.windows.size for record in self.records):
            return self.exact
        steps = self.steps_needed(chromosomes)
        exact, parabolas = (
            by._simulated(chromosomes, steps, balanced=False).values
            for by in (self.exact_means, self)
        )
        missed = (exact - parabolas) / self._noise_of_each()[..., None]
        sizes = np.nan_to_num(np.linalg.norm(missed, axis=(0, 1)), nan=0.0, posinf=0.0)
        most = int(np.argmax(sizes))
        return self._moved_by(missed[..., most], chromosomes[most]) >= _OFF

    def _with_fewest_steps(self, chromosome: FloatArray, moving: float) -> Self:
        exact = self.uneased._in_noise(chromosome)
        for coarseness in _FEWER:
            coarser = self._with(coarseness=coarseness, least=1)
            if np.linalg.norm(coarser._in_noise(chromosome) - exact) < moving:
                return coarser
        for least in _LEAST_STEPS:  # of a record that takes fewer
            coarser = self._with(coarseness=1.0, least=least)
            if not self._bursts(coarser._in_noise(chromosome) - exact, exact):
                return coarser
        return self.uneased

    def _bursts(self, change: FloatArray, exact: FloatArray) -> bool:
        """Whether steps change what any output's innovations of any record are.

        change, exact: (n_residuals, n_outputs), in parts of the noise. Records that are right do
        not hide one whose covariance bursts.
        """
        begins = np.cumsum([0, *(record.n_samples for record in self.records[:-1])])
        changes, sizes = (np.add.reduceat(part**2, begins, axis=0) for part in (change, exact))
        return not bool(np.all(changes <= _BURST**2 * sizes))

    def exactly(self, chromosome: FloatArray) -> Self:
        """With as many integration steps as an answer wants at a chromosome, (n_free,).

        Those that a search goes by may move quantities by more than a part of their deviations.
        """
        exact, finer = self.uneased._in_noise(chromosome), self
        for coarseness in [c for c in (*_FEWER, *_FINER) if c < self.coarseness]:
            if finer._moved_by(finer._in_noise(chromosome) - exact, chromosome) < _PART:
                break
            finer = self._with(coarseness=coarseness)
        return finer

    @property
    def uneased(self) -> Self:
        """With the most integration steps, for chromosomes far from that of ``eased``.

        A free run may hardly move a fast mode that noise moves. Where its steps are too few for
        that, covariances burst, and innovations divided by them are next to nothing.
        """
        return self._with(coarseness=1.0, least=_MANY)

    def _moved_by(self, change: FloatArray, chromosome: FloatArray) -> float:
        """Deviations that a change of the innovations moves any quantity by, at most.

        change: (n_residuals, n_outputs), in parts of the noise. chromosome: (n_free,).
        """
        if not np.linalg.norm(change) > _OFF:
            return 0.0
        steps = self.steps_needed(chromosome[None])
        return moved_by(change, partial(self._each_in_noise, steps), self.space, chromosome)

    def _in_noise(self, chromosome: FloatArray) -> FloatArray:
        """Innovations (n_residuals, n_outputs) at (n_free,) in parts of the outputs' noise."""
        steps = self.steps_needed(chromosome[None])
        return self._each_in_noise(steps, chromosome[None])[..., 0]

    def _each_in_noise(self, steps: IntArray, chromosomes: FloatArray) -> FloatArray:
        """The same of chromosomes (n, n_free), (n_residuals, n_outputs, n), by steps as given."""
        steps = np.repeat(steps, len(chromosomes), axis=0)
        values = self._simulated(chromosomes, steps, balanced=False).values
        return values / self._noise_of_each()[..., None]

    def _noise_of_each(self) -> FloatArray:
        """Noise of the outputs in the units of residuals, (n_residuals, n_outputs)."""
        return self.noise / self.scales_of_each

    def steps_needed(self, chromosomes: FloatArray) -> IntArray:
        """As ``Objective.steps_needed``, of which a filter that corrects needs a part."""
        steps = super().steps_needed(chromosomes)
        part = (steps / self.coarseness).astype(steps.dtype)
        return np.maximum(np.maximum(part, self.least), np.minimum(steps, _FEWEST))

    def _reacting(self, chromosome: FloatArray) -> list[Dataset]:
        """The records with what their inputs do between samples."""
        model, vector = self.simulator.model, self.space.full(chromosome[None])[0]
        starts = self._starts(chromosome[None])
        return [
            with_reactions(model, record, vector, start[0])
            for record, start in zip(self.records, starts, strict=True)
        ]

    def _scatters(self, chromosome: FloatArray | None) -> list[Scatter]:
        """Per record, by free runs at a chromosome, (n_free,), if any."""
        if chromosome is None:
            return [scatter(record) for record in self.records]
        vector = self.space.full(chromosome[None])[0]
        starts = self._starts(chromosome[None])

        def by_run(record: Dataset, start: FloatArray) -> Scatter:
            return scatter(
                record, lambda r: self.simulator.trajectories(vector, r, starts=start)[0]
            )

        return [by_run(*pair) for pair in zip(self.records, starts, strict=True)]

    def settled(self, chromosome: FloatArray) -> Self:
        """With the noise that the innovations show at a chromosome, (n_free,)."""
        steps = self.steps_needed(chromosome[None])
        # Noise of the inputs and of the process may explain nearly all of a free run's error.
        least = (_LEAST_OF_FILTER if self.corrects else _LEAST_NOISE) * self.error
        least = np.maximum(least, self.least_noise)
        settled, last, tested = self, None, np.full(len(self.noise), np.inf)
        for _ in range(_ROUNDS):
            innovations = settled._innovations(chromosome, steps)
            # By less noise a filter may lose states that it keeps by more: what it then errs by
            # would have the noise back.
            if np.any(settled.noise < _ANEW * tested) and settled._may_be_lost(innovations):
                settled, tested = settled._without_lost(chromosome), settled.noise
                innovations = settled._innovations(chromosome, steps)
            before, noise = settled.noise, np.maximum(settled.in_units(innovations), least)
            if not np.isfinite(noise).all():
                return self
            change = np.log(noise / before)
            if last is not None:
                noise = np.maximum(noise * np.exp(_to_the_end(last, change)), least)
            last = change if last is None else None
            settled = settled.of_noise(noise)
            if np.abs(change).max() < _STEADY:
                break
        return settled._as_shown(chromosome, least) if self.corrects else settled

    def _as_shown(self, chromosome: FloatArray, least: FloatArray) -> Self:
        """With the noise of outputs that their samples show, where innovations do not contradict.

        These hardly tell it where noise of the inputs does nearly all of them.
        """
        shown, is_white = self.shown_noise
        wanted = np.where(is_white, shown, np.minimum(self.noise, shown))
        wanted = np.maximum(wanted, least)
        if np.all(wanted == self.noise):
            return self
        as_shown = self.of_noise(wanted)
        steps = self.steps_needed(chromosome[None])
        innovations = as_shown._innovations(chromosome, steps)
        squares = (self.in_units(innovations) / wanted) ** 2
        by_chance = _BY_CHANCE * np.sqrt(2.0 / np.maximum(self.counts, 1))
        return self.of_noise(np.where(np.abs(squares - 1.0) < by_chance, wanted, self.noise))

    def of_noise(self, noise: FloatArray) -> Self:
        """With other noise of the outputs, (n_outputs,)."""
        return self._with(noise=noise)

    def no_more_than(self, rival: Self) -> Self:
        """With no more noise and trust than another for the same records has."""
        trust = np.minimum(np.concatenate(self.trust), np.concatenate(rival.trust))
        return self._trusting(trust).of_noise(np.minimum(self.noise, rival.noise))

    def on(self, records: Sequence[Dataset], places: Sequence[int] | None = None) -> Objective:
        """The same, noise and averages included, on parts of its records."""
        part = super().on(records, places)
        if places is not None:
            colours = [self.colour[place] for place in places]
            variances, shifts = _parts_of([scatter(record) for record in records])
            vars(part).update(colour=colours, scatter=variances, shift=shifts, trust=_full(records))
        else:
            lengths = [record.n_samples for record in records]
            trust = _cut(self.trust, lengths)
            scatters, shifts = (_cut(tables, lengths) for tables in (self.scatter, self.shift))
            vars(part).update(scatter=scatters, shift=shifts, trust=trust)
            if not self.quiet:
                part.counts = _counted(records, np.concatenate(trust))
        return part

    def of_record(self, place: int, record: Dataset) -> Objective:
        """As of ``Objective``, with scatter and trust of the record in whose place it is."""
        part = super().of_record(place, record)
        vars(part).update(
            scatter=[self.scatter[place]], shift=[self.shift[place]], trust=[self.trust[place]]
        )
        return part

    @property
    def coupled(self) -> bool:
        """As of ``Objective``: noise of the process balances all records together."""
        return bool(self.process.any())

    @property
    def least_noise(self) -> FloatArray:
        """Deviation beside the scatter, (n_outputs,), that the tenth with the least not tell all.

        By a part of what the others have: samples that have that much would have twice as much.
        """
        scatter, least = np.concatenate(self.scatter), np.zeros(len(self.noise))
        seen = np.concatenate([np.isfinite(record.outputs) for record in self.records])
        for j in np.flatnonzero(seen.any(axis=0)):
            least[j] = np.sqrt(_PART_OF_TENTH * np.quantile(scatter[seen[:, j], j], _TENTH))
        return least

    @property
    def shown_noise(self) -> tuple[FloatArray, BoolArray]:
        """Deviation of white noise that the outputs' samples show at most, (n_outputs,).

        And whether it is that: where nothing smooth is left in differences of samples, those of
        any order have their part of it, most of the time. Not of means over windows, nor where the
        process has noise.
        """
        most, typical = zip(*(self._of_differences(order) for order in (3, 5)), strict=True)
        rough = np.any(np.concatenate(self.scatter) > 0.0, axis=0) | bool(self.process.any())
        is_white = (typical[1] > 0.0) & (typical[0] < _WHITE * typical[1]) & ~rough
        return np.where(is_white, typical[1], most[0]), is_white

    def _of_differences(self, order: int) -> tuple[FloatArray, FloatArray]:
        """Root mean square of the outputs' differences and most of them, in parts of white noise's.

        (n_outputs,) each; infinite and zero where there are none.
        """
        tables = [np.diff(record.outputs, order, axis=0) for record in self.records]
        differences = np.concatenate(tables) / np.sqrt(comb(2 * order, order))
        seen = np.isfinite(differences).any(axis=0)
        root, typical = np.full(len(seen), np.inf), np.zeros(len(seen))
        root[seen] = np.sqrt(np.nanmean(differences[:, seen] ** 2, axis=0))
        typical[seen] = np.nanmedian(np.abs(differences[:, seen]), axis=0) / MEDIAN_OF_NORMAL
        return root, typical

    @property
    def free_run(self) -> Objective:
        """The objective of the free run's errors, by the same weights."""
        plain = Objective.__new__(Objective)
        vars(plain).update(vars(self))
        return plain

    @property
    def overwhelmed(self) -> BoolArray:
        """Outputs whose errors the noise of the inputs more than explains, (n_outputs,)."""
        scatter = sum(part.sum(axis=0) for part in self.scatter) / np.maximum(self.counts, 1)
        noise = np.sqrt(self.noise**2 + scatter)
        few: BoolArray = (noise < _NEAR * self.error) & (self.weights > 0.0)
        return few

    def bent(self, chromosome: FloatArray) -> FloatArray:
        """Share of the outputs' innovations, (n_outputs,), that a filter misjudges at (n_free,).

        It takes equations for straight over what noise does.
        """
        return self.share_bent(self.bends(chromosome))

    def share_bent(self, bends: FloatArray) -> FloatArray:
        """The same by ``bends``."""
        trust = np.concatenate(self.trust)
        bends = np.where(trust > 0.0, bends, np.nan)  # of what is left out it is known
        parts = bends / (self._noise_of_each() * np.where(trust > 0.0, trust, 1.0))
        seen = np.concatenate([np.isfinite(record.outputs) for record in self.records])
        bent = seen & ~(np.median(np.abs(parts), axis=0) <= _BENT)
        share: FloatArray = bent.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        return share

    @property
    def doubts(self) -> bool:
        """Whether any innovation counts by less than it is."""
        return any(bool(np.any(part < 1.0)) for part in self.trust)

    def renewed(self, chromosome: FloatArray) -> Self:
        """With the trust and the noise that a chromosome, (n_free,), asks for."""
        return self.doubting(chromosome).settled(chromosome)

    def doubting(self, chromosome: FloatArray) -> Self:
        """With innovations counted by the deviations that they have, bends at (n_free,) included.

        It takes in what was measured as before: what was foreseen is uncertain. Where inputs are
        not averaged nothing bends noticeably, or nothing helps but to leave out where a filter has
        lost the states.
        """
        if self.quiet:
            return self._trusting(_trust(self._squared_bends(chromosome)))
        trusting = self._trusting(np.ones_like(np.concatenate(self.trust)))
        innovations = trusting._innovations(chromosome, self.steps_needed(chromosome[None]))
        if not trusting._may_be_lost(innovations):
            return trusting
        return trusting._without_lost(chromosome)

    def _may_be_lost(self, innovations: FloatArray) -> bool:
        """Whether any of a filter's innovations (n_residuals, n_outputs) are by no chance.

        Inputs not averaged, of which ``doubting`` tells anyway.
        """
        if self.quiet or not self.corrects:
            return False
        return not bool(np.abs(innovations / self._noise_of_each()).max() <= _UNLIKELY)

    def _without_lost(self, chromosome: FloatArray) -> Self:
        """Without samples at which it has lost the states at a chromosome, (n_free,).

        Noise of the inputs then moves innovations by more than they deviate, but in proportion.
        Those that it moves by less count the less, so that none is in or out by a hair.
        """
        squares = self._squared_bends(chromosome)
        kept = np.maximum(1.0 - squares.max(axis=1), 0.0)
        seen = np.concatenate([np.isfinite(record.outputs) for record in self.records])
        if np.any(seen[kept == 0.0].sum(axis=0) > _MOSTLY * seen.sum(axis=0)):
            return self
        return self._trusting(kept[:, None] * _trust(squares))

    def _squared_bends(self, chromosome: FloatArray) -> FloatArray:
        """Mean squares of ``_bends`` over the draws, (n_residuals, n_outputs)."""
        bends = self._with(exact=False)._bends(chromosome)
        squares: FloatArray = np.mean(np.where(np.isfinite(bends), bends, 0.0) ** 2, axis=0)
        return squares

    def _trusting(self, trust: FloatArray) -> Self:
        """With the trust (n_residuals, n_outputs), of fewer samples where it leaves some out."""
        ends = np.cumsum([record.n_samples for record in self.records])[:-1]
        counts = self.counts if self.quiet else _counted(self.records, trust)
        return self._with(trust=np.split(trust, ends), counts=counts)

    def bends(self, chromosome: FloatArray) -> FloatArray:
        """What draws of noise do to residuals but in proportion, at (n_free,).

        (n_draws, n_residuals, n_outputs), in the units of residuals; not finite where noise makes
        a simulation fail.
        """
        parts = self._noise_of_each() * np.concatenate(self.trust)
        bends: FloatArray = self._bends(chromosome) * parts
        return bends

    def _bends(self, chromosome: FloatArray) -> FloatArray:
        """What noise does to innovations but in proportion, (n_draws, n_residuals, n_outputs).

        In parts of their deviations. Noise added to the inputs and the same taken from them move
        an innovation by opposite amounts where equations are straight.
        """
        steps = self.steps_needed(chromosome[None])
        rng = np.random.default_rng(0)

        def innovations(moves: list[FloatArray]) -> FloatArray:
            records = [
                replace(record, inputs=record.inputs + move)
                for record, move in zip(self.records, moves, strict=True)
            ]
            moved = self._with(records=records, trust=_full(records))
            values: FloatArray = moved._simulated(chromosome[None], steps, balanced=False).values[
                ..., 0
            ]
            return values

        centre, bends = innovations([np.zeros_like(r.inputs) for r in self.records]), []
        for _ in range(_DRAWS):
            noise = [
                coloured(record.input_noise * rng.standard_normal(record.inputs.shape), colour)
                for record, colour in zip(self.records, self.colour, strict=True)
            ]
            middle = 0.5 * (innovations(noise) + innovations([-move for move in noise]))
            bends.append((middle - centre) / self._noise_of_each())
        return np.array(bends)

    def share(self, chromosome: FloatArray, steps: IntArray) -> FloatArray:
        """Residuals in parts of the free run's where nothing corrects, (n_residuals, n_outputs)."""
        free_run = self.free_run._simulated(chromosome[None], steps[None]).values[..., 0]
        scaled = self._simulated(chromosome[None], steps[None]).values[..., 0]
        share: FloatArray = np.ones_like(scaled)
        np.divide(scaled, free_run, out=share, where=free_run != 0.0)
        return share

    def response(self, chromosome: FloatArray, place: int, n_steps: int) -> LinearResponse:
        """How innovations of the record at a place answer disturbances, at (n_free,).

        Changes are in parts of the outputs' scales.
        """
        return self.simulator.filter_response(
            self.space.full(chromosome[None])[0],
            self.records[place],
            self.scales[place],
            n_steps,
            self._starts(chromosome[None])[place][0],
            self._settings()[place],
        )

    def evaluate(self, chromosomes: FloatArray) -> tuple[FloatArray, BatchResult]:
        """As ``Objective.evaluate``, at the integration steps that the free runs need."""
        steps = self.steps_needed(chromosomes)
        sse = self._simulated(chromosomes, steps).sse
        failed = ~np.isfinite(sse.sum(axis=(1, 2)))
        sse = np.where(failed[:, None, None], np.inf, sse)
        status = np.where(failed, Status.UNBOUNDED, Status.OK)
        errors = self.error_of(self._roots(sse.sum(axis=1)))
        return errors, BatchResult(sse, status, steps.sum(axis=1))

    def _innovations(self, chromosome: FloatArray, steps: IntArray) -> FloatArray:
        """Innovations (n_residuals, n_outputs) at (n_free,), noise of the process not balanced."""
        values: FloatArray = self._simulated(chromosome[None], steps, balanced=False).values[..., 0]
        return values

    def _simulated(
        self, chromosomes: FloatArray, steps: IntArray, *, keep: bool = True, balanced: bool = True
    ) -> Residuals:
        vectors, starts = self.space.full(chromosomes), self._starts(chromosomes)
        return self.simulator.innovations(
            vectors,
            self.records,
            self.scales,
            steps,
            starts,
            self._settings(),
            balanced=balanced,
        )

    def _settings(self) -> list[FilterSettings]:
        """Per record, those of a filter."""
        return [
            FilterSettings(
                self.noise,
                self.scatter[place],
                self.shift[place] * float(self.corrects),
                record.jitter_colour if record.jitter_colour.size else 0.0,
                self.trust[place],
                self.process,
                self.colour[place],
                self.corrects,
                self.exact,
            )
            for place, record in enumerate(self.records)
        ]


def filters(objective: Objective) -> TypeGuard[Innovations]:
    """Whether an objective is of a filter's innovations, which corrects itself."""
    return isinstance(objective, Innovations) and objective.corrects


def _parts_of(scatters: Sequence[Scatter]) -> tuple[list[FloatArray], list[FloatArray]]:
    """Their variances and shifts."""
    return [each.variance for each in scatters], [each.shift for each in scatters]


def _cut(tables: Sequence[FloatArray], lengths: Sequence[int]) -> list[FloatArray]:
    """The first tables, each from its begin as long as that."""
    return [table[:length] for table, length in zip(tables, lengths, strict=False)]


def _counted(records: Sequence[Dataset], trust: FloatArray) -> IntArray:
    """As how many samples those that are seen count, (n_outputs,), by (n_residuals, n_outputs)."""
    seen = np.concatenate([np.isfinite(record.outputs) for record in records])
    counted: IntArray = np.rint(np.sum(np.where(seen, trust, 0.0) ** 2, axis=0)).astype(np.int64)
    return counted


def _trust(squares: FloatArray) -> FloatArray:
    """Parts of innovations that count, by the mean squares of what bends in their deviations."""
    trust: FloatArray = 1.0 / np.sqrt(1.0 + squares)
    return trust


def _full(records: Sequence[Dataset]) -> list[FloatArray]:
    """Trust in all of their samples."""
    return [np.ones(record.outputs.shape) for record in records]


def _may_average(
    objective: Objective, chromosome: FloatArray, steps: IntArray, residual: FloatArray
) -> bool:
    """Whether averages take most of the inputs' noise, and of the free run's outputs next to none.

    residual: that of the inputs as they are, (n_residuals, n_outputs).
    """
    parts = [denoised(record) for record in objective.records]
    pairs = zip(parts, objective.records, strict=True)
    if not all(np.any(part.record.input_noise < _LEFT * r.input_noise) for part, r in pairs):
        return False
    lost = max(float(part.lost.max(initial=0.0)) for part in parts)
    averaged = objective.on([part.record for part in parts])
    moved = averaged.residuals(chromosome[None], steps).values[..., 0] - residual
    return bool(np.sqrt(lost * np.mean(moved**2, axis=0)).max() < _SHOWING)


def _to_the_end(first: FloatArray, second: FloatArray) -> FloatArray:
    """How far two changes in turn go on, were each a constant part of that before (Aitken).

    Where an output's noise is little beside what that of the inputs does, it is nearly all of it.
    """
    slow = (first * second > 0.0) & (np.abs(second) < np.abs(first))
    part = np.divide(second, first, out=np.zeros_like(first), where=slow)
    end: FloatArray = np.clip(second * part / (1.0 - part), -_FARTHEST, _FARTHEST)
    return end
