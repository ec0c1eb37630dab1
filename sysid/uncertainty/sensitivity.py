"""Slopes of the simulated outputs over the parameters, and what errors of the sensors change."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.averages import just_missed
from sysid.fitting.innovations import Innovations, filters
from sysid.fitting.objective import Objective
from sysid.problem.data import Dataset
from sysid.uncertainty.colour import record_rows

# Central differences in search coordinates. Along nearly tied parameters slopes all but cancel, and
# what within the distance is not straight, as friction is not, would stand there for information.
_PERTURBATION = 1e-7
_FILTER_PERTURBATION = 1e-6  # the same where kinks make a filter jump: fewer lie within less
# Part of the larger slopes by which those of both sides differ where there is a kink between them,
# and how many times as far one looks then which of them a jump has made.
_KINK, _FARTHER = 0.01, 100.0
# Of slopes, in parts of the outputs' scale and of a logarithm, or of a unit: beyond it the tangents
# of a stiff simulation, that chatters in small bounds itself, have grown without any.
_BLOWN_UP = 1e12
_JUMP = 10.0  # times that a slope is larger by the shorter distance, from where on it is a jump
# Realisations of the inputs' noise in all records together, and the fewest of one record: they
# give a variance to within 12 % and 25 %.
_DRAWS, _FEWEST_DRAWS = 128, 32
# Shares by which the variance of an output's noise is raised until its innovations show it.
_RAISED = 0.02 * 4.0 ** np.arange(12)
_CHANCE_OF_SHOWN = 3.0  # deviations times the root of the samples of a variance by differences
_SMALL = 0.1  # part of that noise to which a filter answers in proportion, kinks aside
_TINY = 1e-300
_IDLE = 1e-9  # of products of slopes: below this share of the largest they are rounding
# Times what the accuracy allows, that a simulation may err by to be compared with another.
_COMPARABLE = 10.0


@dataclass(frozen=True)
class Sensitivity:
    """Residuals and their slopes at a chromosome, (n_free,), by so many steps for each record.

    residual: (n_residuals, n_outputs), simulated minus measured in parts of the output's scale,
    0 where a sample was lost; seen: of the same shape, where none was. slopes: (n_residuals,
    n_outputs, n_free), with respect to the search coordinates: the natural logarithm of a
    parameter searched by logarithm, else the parameter. share: of the shape of the residuals,
    their factors where noise of inputs divides them, else ones. failing: (n_free,), parameters
    next to whose value a simulation fails, so that their slopes are one-sided. criterion: the
    objective that was minimised; ``objective`` is that of the free run where noise divides it.
    """

    objective: Objective
    chromosome: FloatArray
    steps: list[int]
    residual: FloatArray
    seen: BoolArray
    slopes: FloatArray
    share: FloatArray
    failing: BoolArray
    criterion: Objective

    @property
    def lengths(self) -> tuple[int, ...]:
        """Residuals of each record, which stand one after another."""
        return tuple(record.n_samples for record in self.objective.records)

    @property
    def corrects(self) -> bool:
        """Whether the residuals are innovations of a filter that corrects itself."""
        return filters(self.criterion)

    @cached_property
    def rows(self) -> FloatArray:
        """Slopes of the outputs that have a weight, (n_rows, n_free)."""
        return self.slopes[:, self.objective.weights > 0.0].reshape(-1, len(self.chromosome))

    @cached_property
    def error(self) -> float:
        """What the criterion is at the chromosome."""
        return float(self.criterion.evaluate(self.chromosome[None])[0][0])

    def error_by(self, steps: tuple[int, ...]) -> float:
        """The same by other integration steps per sample, of each record.

        Where those are far too few here, by more steps: elsewhere they may do.
        """
        if steps not in self._errors:
            here = self.criterion.residuals(self.chromosome[None], steps, keep=False)
            enough = tuple(max(pair) for pair in zip(steps, self.steps, strict=True))
            if here.excess[0] <= _COMPARABLE or enough == steps:
                self._errors[steps] = float(self.criterion.error_of(here.rms)[0])
            else:
                self._errors[steps] = self.error_by(enough)
        return self._errors[steps]

    @cached_property
    def _errors(self) -> dict[tuple[int, ...], float]:
        return {}

    @cached_property
    def explains_little(self) -> bool:
        """As of the criterion's ``explains_little``."""
        rms = np.sqrt(np.sum(self.residual**2, axis=0) / np.maximum(self.criterion.counts, 1))
        return self.criterion.explains_little(rms)

    @cached_property
    def bends(self) -> FloatArray:
        """As of ``Innovations.bends``; of no draws without a filter."""
        if filters(self.criterion):
            return self.criterion.bends(self.chromosome)
        return np.zeros((0, *self.residual.shape))

    @cached_property
    def increments(self) -> FloatArray:
        """Change of each parameter per unit of its coordinate, (n_free,)."""
        return np.where(self.objective.space.log, self.chromosome, 1.0)


def sensitivity(objective: Objective, chromosome: FloatArray) -> Sensitivity:
    """Residuals and slopes at a chromosome, (n_free,), by central differences, or exact ones.

    All simulations of a record take as many steps as the most demanding of them needs. Where one
    on one side fails the difference is that on the other side; where both do the slope is zero.
    Where noise of inputs divides the free run's errors it is held: at kinks of the equations it
    jumps, which differences would take for slopes. So do a filter's corrections: of each residual
    that side counts whose slope is the same farther away.
    """
    if objective.exact_slopes:
        exact = _by_tangents(objective, chromosome)
        if _are_slopes(exact.slopes):
            return exact
    share: FloatArray | float = 1.0
    criterion, corrects = objective, filters(objective)
    perturbation = _FILTER_PERTURBATION if corrects else _PERTURBATION
    distance = perturbation * spans(objective, chromosome)
    at, shift = objective.space.encode(chromosome), np.diag(distance)
    around = objective.space.decode(np.concatenate([at[None], at + shift, at - shift]))
    steps = [int(needed) for needed in objective.steps_needed(around).max(axis=0)]
    if isinstance(objective, Innovations) and not objective.corrects:
        share = objective.share(chromosome, np.array(steps))
        objective = objective.free_run
    values = objective.residuals(around, steps).values
    centre, n = values[..., :1], len(chromosome)
    runs: BoolArray = np.all(np.isfinite(values[..., 1:]), axis=(0, 1))
    changes = np.where(runs, values[..., 1:] - centre, 0.0)
    sides = runs[:n].astype(int) + runs[n:]
    slopes = (changes[..., :n] - changes[..., n:]) / (np.maximum(sides, 1) * distance)
    if corrects:
        near = np.stack([changes[..., :n], -changes[..., n:]]) / distance
        # Next to kinks the chromosome itself may lie on one, where both sides jump alike.
        two = np.flatnonzero((sides == 2) & _kinks(*near)[sides == 2].any())
        moves = _FARTHER * shift[two]
        around = objective.space.decode(np.concatenate([at + moves, at - moves]))
        ahead, behind = np.split(objective.residuals(around, steps).values - centre, 2, axis=-1)
        far = np.stack([ahead, -behind]) / (_FARTHER * distance[two])
        slopes[..., two] = _without_jumps(near[..., two], far)
    seen = np.concatenate([np.isfinite(record.outputs) for record in objective.records])
    factors = np.broadcast_to(share, seen.shape)
    residual, slopes = factors * centre[..., 0], factors[..., None] * slopes
    return Sensitivity(
        objective, chromosome, steps, residual, seen, slopes, factors, sides < 2, criterion
    )


def has_tangents(objective: Objective, chromosome: FloatArray) -> bool:
    """Whether exact slopes are those of its simulations at a chromosome, (n_free,)."""
    return objective.exact_slopes and _are_slopes(_by_tangents(objective, chromosome).slopes)


def _are_slopes(slopes: FloatArray) -> bool:
    return bool(np.abs(slopes).max(initial=0.0) < _BLOWN_UP)  # never where one is NaN


def _by_tangents(objective: Objective, chromosome: FloatArray) -> Sensitivity:
    steps = objective.steps_needed(chromosome[None])
    residual = objective.residuals(chromosome[None], steps).values[..., 0]
    slopes = objective.tangents(chromosome[None], steps)[0].dense
    seen = np.concatenate([np.isfinite(record.outputs) for record in objective.records])
    failing = np.zeros(len(chromosome), dtype=bool)
    return Sensitivity(
        objective, chromosome, steps[0].tolist(), residual, seen, slopes, np.ones(seen.shape),
        failing, objective,
    )  # fmt: skip


def slopes_along(local: Sensitivity, directions: FloatArray) -> FloatArray:
    """Slopes along directions (n, n_free) of the search coordinates, (n_residuals, n_outputs, n).

    By differences along each of them: where all parameters of a direction move together and leave
    the states alone, no kink is passed that any of them would pass by itself.
    """
    objective, chromosome = local.objective, local.chromosome
    sizes = np.max(np.abs(directions) / spans(objective, chromosome), axis=1, initial=0.0)
    distance = _FILTER_PERTURBATION / np.maximum(sizes, _TINY)
    at, shift = objective.space.encode(chromosome), distance[:, None] * directions
    around = objective.space.decode(np.concatenate([at + shift, at - shift]))
    ahead, behind = np.split(objective.residuals(around, local.steps).values, 2, axis=-1)
    slopes: FloatArray = local.share[..., None] * (ahead - behind) / (2.0 * distance)
    return slopes


def _kinks(ahead: FloatArray, behind: FloatArray) -> BoolArray:
    """Which parameters' slopes differ between both sides, (n_free,)."""
    size = np.maximum(*(np.linalg.norm(side, axis=(0, 1)) for side in (ahead, behind)))
    kinks: BoolArray = np.linalg.norm(ahead - behind, axis=(0, 1)) > _KINK * size
    return kinks


def _without_jumps(near: FloatArray, far: FloatArray) -> FloatArray:
    """Slopes by differences over a distance and over a longer one, each (2, ...) on both sides.

    A jump is seen as a slope that goes with the distance's inverse. Where both sides agree least
    badly their mean counts, else the side on which both distances agree better; where both jump,
    the longer distance.
    """
    (ahead, behind), unsteady = near, np.abs(near - far)
    unsteady = np.where(np.isfinite(unsteady), unsteady, np.inf)
    side = np.where(unsteady[0] <= unsteady[1], ahead, behind)
    mean, farther = 0.5 * (ahead + behind), 0.5 * (far[0] + far[1])
    slopes: FloatArray = np.where(np.abs(ahead - behind) <= unsteady.min(axis=0), mean, side)
    jumps = _JUMP * np.abs(far).max(axis=0) < np.abs(near).min(axis=0)
    slopes[jumps] = farther[jumps]
    return slopes


def spans(objective: Objective, chromosome: FloatArray) -> FloatArray:
    """Changes of the search coordinates that are neither small nor large, (n_free,)."""
    space = objective.space
    linear = np.maximum(np.abs(chromosome), 0.05 * (space.upper - space.lower))
    return np.where(space.log, 1.0, linear)


def zero_errors(sensitivity: Sensitivity) -> Iterator[FloatArray]:
    """Changes (n_residuals, n_outputs) by a standard deviation of each channel's zero error.

    And of parameters that were given, which are as constant.
    """
    records = sensitivity.objective.records
    for places in sharing_zeros(records):
        first = records[places[0]]
        for j in np.flatnonzero(first.output_zero).tolist():
            yield sum((_by_output_zero(sensitivity, k, j) for k in places), np.zeros(()))
        errors = each_alone(first.input_zero)
        parts = [_input_changes(sensitivity, k, errors) for k in places]
        yield from (sum(changes, np.zeros(())) for changes in zip(*parts, strict=True))
    yield from given_errors(sensitivity)


def each_alone(deviations: FloatArray) -> list[FloatArray]:
    """Of channels (n,) the deviation of each that has one, alone."""
    return [error for error in np.diag(deviations) if error.any()]


def sharing_zeros(records: Sequence[Dataset]) -> list[list[int]]:
    """Places of records whose channels' zeros were calibrated once: the parts of a longer one.

    >>> whole = Dataset(np.zeros(4), np.zeros(4), 0.1)
    >>> sharing_zeros([whole, replace(whole, log=0), whole, replace(whole, log=0)])
    [[0], [1, 3], [2]]
    """
    logs: dict[tuple[int, int | None], list[int]] = {}
    for k, record in enumerate(records):
        logs.setdefault((k, None) if record.log is None else (-1, record.log), []).append(k)
    return [*logs.values()]


def _by_output_zero(sensitivity: Sensitivity, k: int, j: int) -> FloatArray:
    """Change of all residuals by a deviation of the zero of output j of record k."""
    objective, record = sensitivity.objective, sensitivity.objective.records[k]
    if isinstance(objective, Innovations):
        outputs = record.outputs.copy()
        outputs[:, j] += record.output_zero[j]
        return _change_by_record(sensitivity, k, replace(record, outputs=outputs))
    change = np.zeros_like(sensitivity.residual)
    rows = record_rows(sensitivity.lengths)[k]
    change[rows, j] = record.output_zero[j] / objective.scales[k][j]
    return change * sensitivity.share


def given_errors(sensitivity: Sensitivity) -> Iterator[FloatArray]:
    """Changes (n_residuals, n_outputs) by a standard deviation of what ``Objective.given`` holds.

    They shift all samples of all records together, as errors of a sensor's zero do.
    """
    objective, chromosomes = sensitivity.objective, sensitivity.chromosome[None]
    space, records = objective.space, objective.records
    declared = [record.initial_state(objective.simulator.model) for record in records]
    starts = [space.starts(chromosomes.repeat(2, axis=0), k, x) for k, x in enumerate(declared)]
    steps = np.repeat([sensitivity.steps], 2, axis=0)
    for change in objective.given:
        size = np.max(np.abs(change) / np.maximum(np.abs(space.base), 1e-300), initial=1e-300)
        bases = [space.base + sign * _PERTURBATION / size * change for sign in (1.0, -1.0)]
        vectors = np.concatenate([replace(space, base=base).full(chromosomes) for base in bases])
        up, down = np.moveaxis(
            objective.simulator.residuals(vectors, records, objective.scales, steps, starts).values,
            -1,
            0,
        )
        slope = (up - down) / (2.0 * _PERTURBATION / size)
        yield np.where(np.isfinite(slope), slope, 0.0)


def start_errors(sensitivity: Sensitivity) -> Iterator[tuple[int, FloatArray]]:
    """Changes (n_residuals, n_outputs) by a deviation of each first sample that a run starts at.

    Behind the place of the state that starts there. Such a run keeps the noise of one sample for
    as long as the plant remembers its start.
    """
    objective = sensitivity.objective
    places = zip(objective.records, record_rows(sensitivity.lengths), objective.scales, strict=True)
    for k, (record, rows, scale) in enumerate(places):
        left = sensitivity.residual[rows] * scale
        for state, j in enumerate(record.starts_at_samples(objective.simulator.model)):
            if j is None:
                continue
            outputs = record.outputs.copy()
            outputs[0, j] += record.sample_noise(j, left[:, j])
            change = _change_by_record(sensitivity, k, replace(record, outputs=outputs))
            yield state, change * sensitivity.share


def parabola_errors(sensitivity: Sensitivity) -> Iterator[FloatArray]:
    """Change (n_residuals, n_outputs) by what averaged outputs are but no parabola.

    It repeats itself with the inputs, so that more samples do not average it away.
    """
    objective, change = sensitivity.objective, np.zeros_like(sensitivity.residual)
    if isinstance(objective, Innovations) and objective.exact:
        return
    simulator, chromosomes = objective.simulator, sensitivity.chromosome[None]
    vectors = objective.space.full(chromosomes)
    for k, record in enumerate(objective.records):
        if not record.windows.size:
            continue
        starts = objective.space.starts(chromosomes, k, record.initial_state(simulator.model))
        beyond = simulator.beyond_parabolas(vectors, record, starts=starts)[0]
        outputs = record.outputs - np.where(np.isfinite(beyond), beyond, 0.0)
        moved = _change_by_record(sensitivity, k, replace(record, outputs=outputs))
        change += moved * sensitivity.share
    yield change


def bend_errors(local: Sensitivity) -> Iterator[FloatArray]:
    """Change (n_residuals, n_outputs) of a filter's innovations by equations that noise bends.

    Its mean over draws of that noise, which acts in one way on all samples alike, times how much
    of it there may be: what no parameter takes up of it is seen in the residuals, or is missing
    there, as after a turn that some draws take and the data did not. share: how much is seen; of
    draws that differ the products of two tell how well it would be.
    """
    bends = np.where(np.isfinite(local.bends), local.bends, 0.0)
    if not len(bends):
        return
    mean, errors = bends.mean(axis=0), _of_deviation(local.residual, local)
    across = _across(local, np.array([_of_deviation(bend, local) for bend in bends]))
    seen, n = across.mean(axis=0), len(bends)
    products = (n * np.sum(seen**2) - np.mean(np.sum(across**2, axis=(1, 2)))) / (n - 1)
    share = np.sum(seen * errors) / (1.0 + np.sum(seen**2))
    yield mean * min(1.0, float(np.hypot(share, 1.0 / np.sqrt(1.0 + max(products, 0.0)))))


def _of_deviation(errors: FloatArray, local: Sensitivity) -> FloatArray:
    """Errors (n_residuals, n_outputs) in deviations of what is left of each output."""
    left: FloatArray = np.sqrt(
        np.sum(local.residual**2, axis=0) / np.maximum(local.criterion.counts, 1)
    )
    return np.divide(errors, left, out=np.zeros_like(errors), where=left > 0.0)


def _across(local: Sensitivity, errors: FloatArray) -> FloatArray:
    """What no parameters make of errors (n, n_residuals, n_outputs), in deviations."""
    slopes = np.moveaxis(local.slopes, 2, 0)
    rows = np.array([_of_deviation(column, local).ravel() for column in slopes])
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), _TINY)
    columns = errors.reshape(len(errors), -1)
    inverse = np.linalg.pinv(rows @ rows.T, _IDLE, hermitian=True)
    across: FloatArray = columns - columns @ rows.T @ inverse @ rows
    return across.reshape(errors.shape)


def averages_errors(sensitivity: Sensitivity) -> Iterator[FloatArray]:
    """Changes (n_residuals, n_outputs) by what averages of noisy inputs may take of the signal.

    How wide they are is a choice, and what they take repeats itself with the inputs. It is taken
    for as large as the noise that narrower ones would let through, drawn at random, always the
    same, and acts in proportion.
    """
    objective = sensitivity.objective
    if not (isinstance(objective, Innovations) and objective.quiet):
        return
    rng = np.random.default_rng(0)
    for k, record in enumerate(objective.records):
        colour = objective.colour[k]
        noise = record.input_noise * np.sqrt((1.0 + colour) / (1.0 - colour))
        for _ in range(_FEWEST_DRAWS):
            missed = just_missed(noise * rng.standard_normal(record.inputs.shape), colour)
            moved = replace(record, inputs=record.inputs + _SMALL * missed)
            yield _change_by_record(sensitivity, k, moved) / (_SMALL * np.sqrt(_FEWEST_DRAWS))


def raised_noises(
    local: Sensitivity, weight: FloatArray
) -> Iterator[tuple[Sensitivity, FloatArray, float]]:
    """Filters by more noise of an output each, and a standard deviation of it in parts of that.

    The noise is such that the innovations' mean square is what the filter expects, which chance
    moves; where noise of the inputs does most of it, it is hardly known. weight: (n_outputs,), of
    the squares; the filters have theirs, as weights follow the errors.
    """
    fitted, residual = local.criterion, local.residual
    if not filters(fitted):
        return
    for j in np.flatnonzero((fitted.weights > 0.0) & (fitted.counts > 1)):
        squares = residual[local.seen[:, j], j] ** 2
        if not squares.any():  # an output that never errs
            continue
        deviation = squares.std() / squares.mean() / np.sqrt(len(squares))
        chromosome, fall = local.chromosome[None], 0.0
        noise = fitted.noise.copy()
        for raised in _RAISED:
            noise[j] = fitted.noise[j] * np.sqrt(1.0 + raised)
            raised_filter = fitted.of_noise(noise)
            innovations = raised_filter.residuals(chromosome, local.steps).values[..., 0]
            left = np.mean(innovations[local.seen[:, j], j] ** 2) / (1.0 + raised)
            fall = 1.0 - left / squares.mean()
            if not fall < deviation:
                break
        if not (np.isfinite(fall) and fall > 0.0):
            continue
        moved = sensitivity(raised_filter, local.chromosome)
        sizes = np.sum(residual**2, axis=0) / np.maximum(np.sum(moved.residual**2, axis=0), _TINY)
        # It is between nothing and what the output's samples show, or known by these.
        shown, is_white = fitted.shown_noise
        most = _CHANCE_OF_SHOWN / np.sqrt(fitted.counts[j]) if is_white[j] else 1.0
        raises = min(deviation / fall, most * float(shown[j] / fitted.noise[j]) ** 2 / raised)
        yield moved, weight * sizes, raises * _of_positive(1.0 / (raises * raised))


def _of_positive(mean: float) -> float:
    """Deviation of a normal variable of unit deviation whose values below zero count as zero.

    As a variance's estimate, which has no others. mean: of the normal one, zero or above.
    """
    below, density = ndtr(-mean), np.exp(-0.5 * mean**2) / np.sqrt(2.0 * np.pi)
    first = mean * (1.0 - below) + density
    second = (mean**2 + 1.0) * (1.0 - below) + mean * density
    return float(np.sqrt(second - first**2))


def input_noises(sensitivity: Sensitivity) -> Iterator[tuple[slice, FloatArray]]:
    """Rows of each record's residuals, and their changes by noise of its inputs.

    Outer products of the changes (n_samples, n_outputs, n_draws) sum to their covariance; the noise
    is drawn at random, always the same. Records are independent, so that all draws of all of them
    tell the covariance of a sum over them as well as those of one would. None for innovations of a
    filter that corrects itself, which hold it already.
    """
    if isinstance(sensitivity.objective, Innovations):
        return
    records = sensitivity.objective.records
    rng, places = np.random.default_rng(0), record_rows(sensitivity.lengths)
    noisy = [k for k, record in enumerate(records) if np.any(record.input_noise)]
    total = sum(records[k].n_samples for k in noisy)
    for k in noisy:
        shape, noise = records[k].inputs.shape, records[k].input_noise
        draws = max(-(-_DRAWS * records[k].n_samples // total), _FEWEST_DRAWS)
        errors = (rng.standard_normal(shape) * noise for _ in range(draws))
        changes = np.stack(list(_driven_changes(sensitivity, k, errors)), axis=2)
        yield places[k], changes / np.sqrt(draws)


def _input_changes(
    sensitivity: Sensitivity, k: int, errors: Iterable[FloatArray]
) -> Iterator[FloatArray]:
    """Changes of all residuals by errors of record k's inputs, (n_samples, n_inputs) or a row."""
    objective, record = sensitivity.objective, sensitivity.objective.records[k]
    if isinstance(objective, Innovations):
        for error in errors:
            disturbed_record = replace(record, inputs=record.inputs + error)
            yield _change_by_record(sensitivity, k, disturbed_record)
        return
    rows = record_rows(sensitivity.lengths)[k]
    for part in _driven_changes(sensitivity, k, errors):
        change = np.zeros_like(sensitivity.residual)
        change[rows] = part
        yield change


def _driven_changes(
    sensitivity: Sensitivity, k: int, errors: Iterable[FloatArray]
) -> Iterator[FloatArray]:
    """Changes (n_samples, n_outputs) of a free run's residuals of record k by errors of inputs."""
    objective, record = sensitivity.objective, sensitivity.objective.records[k]
    share = sensitivity.share[record_rows(sensitivity.lengths)[k]]
    chromosomes = sensitivity.chromosome[None]
    vectors = objective.space.full(chromosomes)
    initial = record.initial_state(objective.simulator.model)
    starts = objective.space.starts(chromosomes, k, initial)

    def outputs(record: Dataset) -> FloatArray:
        steps = sensitivity.steps[k]
        simulated: FloatArray = objective.simulator.trajectories(vectors, record, steps, starts)[0]
        return simulated

    undisturbed = None
    for error in errors:
        undisturbed = outputs(record) if undisturbed is None else undisturbed
        disturbed = outputs(replace(record, inputs=record.inputs + error))
        difference = (disturbed - undisturbed) / objective.scales[k]
        yield np.where(np.isfinite(difference), difference, 0.0) * share


def _change_by_record(sensitivity: Sensitivity, k: int, record: Dataset) -> FloatArray:
    """Change of all residuals with another record k."""
    objective, chromosome = sensitivity.objective, sensitivity.chromosome[None]
    rows, steps = slice(None), sensitivity.steps
    if objective.coupled:
        records = list(objective.records)
        records[k] = record
        disturbed = objective.on(records)
    else:
        rows, steps = record_rows(sensitivity.lengths)[k], steps[k : k + 1]
        disturbed = objective.of_record(k, record)
    moved = disturbed.residuals(chromosome, steps).values[..., 0] - sensitivity.residual[rows]
    change = np.zeros_like(sensitivity.residual)
    change[rows] = np.where(np.isfinite(moved), moved, 0.0)
    return change
