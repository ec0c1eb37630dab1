"""What residuals hold whatever a model lacks: noise, errors of the sensors, and of the simulation.

Of free runs, or of a filter's innovations. Of these all is counted with the gains as they are. That
gains, and the deviations by which innovations are divided, move with the parameters makes up for
the noise of measured inputs where parameters are fitted; here a Wiener filter tells that noise, and
the slopes over the parameters are those of what was foreseen alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.averages import just_missed
from sysid.fitting.innovations import Innovations
from sysid.fitting.means import scatter
from sysid.fitting.objective import Objective
from sysid.judging.disturbed import DisturbedRun, of_each
from sysid.judging.filtered import FilteredRun
from sysid.judging.input_noise import quieted
from sysid.problem.data import Dataset
from sysid.threads import Workers
from sysid.uncertainty.colour import record_rows
from sysid.uncertainty.sensitivity import (
    Sensitivity,
    each_alone,
    input_noises,
    sensitivity,
    sharing_zeros,
    spans,
    zero_errors,
)

_TINY = 1e-300
_ITERATIONS = 20  # by which residuals' variances settle
_COMMON = 0.15  # of the windows' jitter, that they may all lie too early or too late
_INEXACT = 1e-2  # of the residuals' deviation, from where a simulation's error shows in them
_DRAWS = 32  # of what averages may take
_MEMORY = 5  # innovations before each that it may follow
_STEP = 1e-6  # of a coordinate, for slopes of the parameters over it


@dataclass(frozen=True)
class Background:
    """Changes of the outputs, (n_rows, n_outputs, k), that are there whatever is missing.

    foreseen: of any size. chance: by one standard deviation of what is known to be so large.
    noises: rows of records, and changes of their residuals by draws of what is not known, as of
    ``input_noises``. weights: (n_rows, n_outputs), what each residual counts.
    """

    foreseen: FloatArray
    chance: FloatArray
    noises: Sequence[tuple[slice, FloatArray]]
    weights: FloatArray


def quiet_sensitivity(objective: Objective, chromosome: FloatArray) -> Sensitivity:
    """Residuals, and slopes along runs without what is likely to be noise of the inputs.

    Slopes along runs that the noise has moved go with the errors that it makes.
    """
    quiet = objective.on([quieted(record) for record in objective.records])
    local = sensitivity(quiet, chromosome)
    residual = objective.residuals(chromosome[None], local.steps).values[..., 0]
    return replace(local, residual=residual)


def of_free_runs(
    local: Sensitivity, records: Sequence[Dataset]
) -> tuple[Sensitivity, list[DisturbedRun], Background]:
    """The free runs of residuals and slopes, as of ``quiet_sensitivity``, and what they hold.

    records: as they were measured.
    """
    objective, chromosomes = local.objective, local.chromosome[None]
    model, vector = objective.simulator.model, objective.space.full(chromosomes)[0]
    workers, runs = Workers(objective.simulator.threads), []
    for k, record in enumerate(records):
        start = objective.space.starts(chromosomes, k, record.initial_state(model))[0]
        runs.append(DisturbedRun.free(model, vector, record, start, local.steps[k], workers))
    scales, none = objective.scales_of_each, np.zeros(local.residual.shape)
    zeros = np.stack([none, *(zero * scales for zero in zero_errors(local))], axis=2)
    inexact = _simulation_error(runs, local)
    local = replace(local, residual=local.residual + _between_samples(runs, local) / scales)
    return (
        local,
        runs,
        Background(
            _felt(_foreseen_noise(runs), inexact),
            np.concatenate(
                [zeros[..., 1:], _noisy_starts(runs, local), _moved_windows(runs, "its")], axis=2
            ),
            list(input_noises(local)),
            _weights(runs, local),
        ),
    )


def of_filter(local: Sensitivity) -> tuple[Sensitivity, list[FilteredRun], Background]:
    """The filter's runs of innovations, with slopes at its gains, and what they hold."""
    objective = local.objective
    assert isinstance(objective, Innovations)
    workers, runs = Workers(objective.simulator.threads), []
    for k, n_steps in enumerate(local.steps):
        response = objective.response(local.chromosome, k, n_steps)
        runs.append(FilteredRun.of(objective, local.chromosome, k, response, workers))
    bends = np.moveaxis(np.where(np.isfinite(local.bends), local.bends, 0.0), 0, 2)
    foreseen = (
        _foreseen_noise(runs),
        _noisy_inputs(runs),
        _innovations_before(local),
        _coarseness(objective, local),
    )
    return (
        replace(local, slopes=_slopes(local, runs)),
        runs,
        Background(
            _felt(*foreseen),
            np.concatenate([_zeros(runs, local), _moved_windows(runs, "its", "all")], axis=2),
            list(_approximations(runs, local, bends)),
            np.ones(local.residual.shape),
        ),
    )


def _felt(*changes: FloatArray) -> FloatArray:
    """All that change anything, (n_rows, n_outputs, k)."""
    whole = np.concatenate(changes, axis=2)
    return whole[..., whole.any(axis=(0, 1))]


def _slopes(local: Sensitivity, runs: Sequence[FilteredRun]) -> FloatArray:
    """Slopes of innovations over coordinates, (n_rows, n_outputs, n_free), gains as they are."""
    space, at = local.objective.space, local.objective.space.encode(local.chromosome)
    shift = _STEP * np.diag(spans(local.objective, local.chromosome))
    up, down = (space.decode(at + sign * shift) for sign in (1.0, -1.0))
    distance = 2.0 * np.diag(shift)[:, None]
    vectors = (space.full(up) - space.full(down)) / distance
    slopes = np.zeros(local.slopes.shape)
    places = enumerate(zip(runs, record_rows(local.lengths), strict=True))
    for k, (run, rows) in places:
        starts = (space.starts(up, k, run.start) - space.starts(down, k, run.start)) / distance
        for i, moves in enumerate(zip(vectors, starts, strict=True)):
            slopes[rows, :, i] = run.moved(*moves) / run.scale
    return slopes


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
    part[:, i] = run.likely_noise(i)
    return run.driven(part)


def _noisy_inputs(runs: Sequence[FilteredRun]) -> FloatArray:
    """What inputs with noise do by their changes, (n_rows, n_outputs, k).

    How much of these is noise is not known well enough to tell a gain.
    """
    noisy = np.flatnonzero(np.any([run.record.input_noise for run in runs], axis=0))
    columns = [of_each(runs, partial(_by_input, i)) for i in noisy.tolist()]
    return np.stack(columns, axis=2)


def _by_input(i: int, run: FilteredRun) -> FloatArray:
    part = np.zeros(run.record.inputs.shape)
    part[:, i] = run.record.inputs[:, i] - run.record.inputs[:, i].mean()
    return run.driven(part)


def _innovations_before(local: Sensitivity) -> FloatArray:
    """Each output's innovations before, of some lags, (n_rows, n_outputs, k).

    What follows of the estimate goes with them: colour that they have would be laid to that.
    """
    lags = np.zeros((*local.residual.shape, local.residual.shape[1] * _MEMORY))
    for rows, scale in zip(record_rows(local.lengths), local.objective.scales, strict=True):
        for j in range(local.residual.shape[1]):
            at = rows.start + np.flatnonzero(local.seen[rows, j])
            for lag in range(1, min(_MEMORY, len(at) - 1) + 1):
                before = scale[j] * local.residual[at[:-lag], j]
                lags[at[lag:], j, _MEMORY * j + lag - 1] = before
    return lags


def _simulation_error(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """What a finer integration changes in the outputs, (n_rows, n_outputs, 1); none if little."""
    pieces = []
    residual = local.objective.residuals(local.chromosome[None], local.steps).values[..., 0]
    for run, rows, scale in zip(
        runs, record_rows(local.lengths), local.objective.scales, strict=True
    ):
        left = residual[rows] * scale
        coarse = np.where(local.seen[rows], run.record.outputs + left, run.outputs)
        pieces.append(run.outputs - coarse)
    error = np.concatenate(pieces)[..., None]
    size = np.sqrt(np.mean(error[..., 0] ** 2, axis=0))
    left = np.sqrt(np.mean(local.residual**2, axis=0)) * np.mean(local.objective.scales, axis=0)
    return error if np.any(size > _INEXACT * left) else error[..., :0]


def _between_samples(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """What runs miss that take inputs for straight lines and averaged outputs for parabolas.

    (n_rows, n_outputs), 0 where a sample was lost. It comes again with the inputs: of a right model
    it would be laid to a channel that is late.
    """
    simulator, pieces = local.objective.simulator, []
    for run, n_steps in zip(runs, local.steps, strict=True):
        vector, start = run.vector[None], run.start[None]
        beyond = simulator.beyond_parabolas(vector, run.record, n_steps, start)[0]
        pieces.append(run.reacted() + np.where(np.isfinite(beyond), beyond, 0.0))
    return np.where(local.seen, np.concatenate(pieces), 0.0)


def _coarseness(objective: Innovations, local: Sensitivity) -> FloatArray:
    """What more integration steps change in innovations, (n_rows, n_outputs, 1); none if little."""
    fine, chromosomes = objective.uneased, local.chromosome[None]
    exact = fine.residuals(chromosomes, fine.steps_needed(chromosomes)).values[..., 0]
    error = np.where(np.isfinite(exact), exact - local.residual, 0.0)[..., None]
    size, left = (np.mean(part**2, axis=0) for part in (error[..., 0], local.residual))
    felt = bool(np.any(size > _INEXACT**2 * left))
    return error[..., : int(felt)] * objective.scales_of_each[..., None]


def _zeros(runs: Sequence[FilteredRun], local: Sensitivity) -> FloatArray:
    """As of ``zero_errors``, with gains as they are, (n_rows, n_outputs, k)."""
    columns, rows = [], record_rows(local.lengths)
    for places in sharing_zeros([run.record for run in runs]):
        changes = [_by_zeros(runs[k]) for k in places]
        for parts in zip(*changes, strict=True):
            column = np.zeros(local.residual.shape)
            for k, part in zip(places, parts, strict=True):
                column[rows[k]] = part / runs[k].scale
            columns.append(column)
    for vector in local.objective.given:
        start = np.zeros(len(runs[0].model.states))
        columns.append(np.concatenate([run.moved(vector, start) / run.scale for run in runs]))
    return np.stack([np.zeros(local.residual.shape), *columns], axis=2)[..., 1:]


def _by_zeros(run: FilteredRun) -> list[FloatArray]:
    """Changes of a run by a deviation of each channel's zero, outputs first."""
    outputs, inputs = run.record.outputs, run.record.inputs
    changes = [run.logged(_throughout(outputs, e)) for e in each_alone(run.record.output_zero)]
    return changes + [run.driven(_throughout(inputs, e)) for e in each_alone(run.record.input_zero)]


def _throughout(like: FloatArray, values: FloatArray) -> FloatArray:
    return np.broadcast_to(values, like.shape)


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


def _moved_windows(runs: Sequence[DisturbedRun], *ways: str) -> FloatArray:
    """Changes (n_rows, n_outputs, k) by what windows may lie too late.

    That each is known to within its jitter does not say that they are right in the mean: by a part
    of ``its`` jitter each, or ``all`` by the same.
    """
    changes = [of_each(runs, partial(_later, way)) for way in ways]
    return _felt(np.stack(changes, axis=2))


def _later(way: str, run: DisturbedRun) -> FloatArray:
    jitter = run.record.jitter
    if not jitter.any():
        return np.zeros_like(run.outputs)
    squares = np.sum(jitter**2, axis=0) / np.maximum((jitter > 0.0).sum(axis=0), 1)
    shift = np.where(jitter > 0.0, np.sqrt(squares), 0.0) if way == "all" else jitter
    later = run.record.windows - _COMMON * shift[..., None]
    return run.logged(run.over(later) - run.outputs)


def _approximations(
    runs: Sequence[FilteredRun], local: Sensitivity, bends: FloatArray
) -> Iterator[tuple[slice, FloatArray]]:
    """As of ``input_noises``, what a filter that averages its inputs leaves out of account.

    What averages may take of the signal, and where equations bend over what noise is left.
    """
    rng = np.random.default_rng(0)
    for run, rows in zip(runs, record_rows(local.lengths), strict=True):
        record, colour = run.record, run.colour
        noise = record.input_noise * np.sqrt((1.0 + colour) / (1.0 - colour))
        missed = [
            run.driven(just_missed(noise * rng.standard_normal(record.inputs.shape), colour))
            for _ in range(_DRAWS)
        ]
        lost = np.stack(missed, axis=2) / run.scale[:, None] / np.sqrt(_DRAWS)
        yield rows, np.concatenate([lost, bends[rows] / np.sqrt(bends.shape[2])], axis=2)


def _weights(runs: Sequence[DisturbedRun], local: Sensitivity) -> FloatArray:
    """What each residual counts, (n_rows, n_outputs), by its deviation in parts of the smallest.

    Of a mean over a time that is not well known the deviation is larger where the output changes
    fast (``scatter``). As regressions weigh all alike, a few such means would decide.
    """

    def scattered(run: DisturbedRun) -> FloatArray:
        return scatter(run.record, lambda record: run.over(record.windows)).variance

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
