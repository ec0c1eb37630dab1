"""What the equations leave undetermined, in the search coordinates of an identification."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.linalg import null_space

from sysid.arrays import BoolArray, FloatArray
from sysid.identifiability.cache import kept_identifiability
from sysid.problem.model import ModelError, ProcessModel
from sysid.problem.space import SearchSpace
from sysid.uncertainty.estimate import Invariant
from sysid.uncertainty.sensitivity import Sensitivity, slopes_along

# Of what one parameter of a direction does by itself.
_FELT = 0.2
_NOTHING = 1e-9  # entries of a direction below this are rounding


@dataclass(frozen=True)
class Ties:
    """Directions of the search coordinates that leave the outputs of any data alone, (n, n_free).

    combinations: of the parameters in them, that outputs show.
    """

    directions: FloatArray
    combinations: Sequence[Invariant] = ()

    @classmethod
    def of(
        cls,
        space: SearchSpace,
        chromosome: FloatArray,
        combinations: Sequence[Invariant],
        members: Collection[str],
    ) -> Self:
        """Of parameters and starts, of which the outputs show these combinations and no others."""
        values = named_values(space, chromosome)
        gradients = [free_gradient(combination, space, values) for combination in combinations]
        # The starts of several records are numbered behind their names.
        alone = [name.partition(" ")[0] not in members for name in space.names]
        by_values = np.concatenate([np.eye(len(alone))[alone], *map(np.atleast_2d, gradients)])
        rows = by_values * np.where(space.log, chromosome, 1.0)
        return cls(_sparse(null_space(rows / _lengths(rows)).T), combinations)

    @property
    def bound(self) -> list[bool]:
        """Which parameters are tied, (n_free,)."""
        tied: list[bool] = np.any(self.directions != 0.0, axis=0).tolist()
        return tied

    def groups(self) -> list[tuple[list[int], FloatArray]]:
        """Places of parameters that hang together, and their directions (k, n_free)."""
        groups: list[tuple[set[int], list[int]]] = []
        for row, moved in enumerate(self.directions != 0.0):
            members, rows = set(np.flatnonzero(moved).tolist()), [row]
            near = [group for group in groups if group[0] & members]
            groups = [group for group in groups if group not in near]
            groups.append(
                (members.union(*(g for g, _ in near)), rows + [r for _, rs in near for r in rs])
            )
        return [(sorted(members), self.directions[rows]) for members, rows in groups]


class Shown:
    """Chromosomes but for what outputs do not show of them: the tied by their combinations.

    Where not all combinations have a name all coordinates count.

    >>> from sysid.examples import lag
    >>> space, chromosome = SearchSpace.of(lag()), np.array([1.0, 0.5])
    >>> shown = Shown(Ties(np.zeros((0, 2))), space, chromosome)
    >>> (shown.coordinates(2.0 * chromosome) - shown.coordinates(chromosome)).round(3)
    array([0.693, 0.693])
    """

    def __init__(self, ties: Ties, space: SearchSpace, chromosome: FloatArray) -> None:
        self._space, self._here = space, named_values(space, chromosome)
        alone, self._combinations = ~np.array(ties.bound, dtype=bool), ties.combinations
        gradients = [coded_gradient(c, space, chromosome) for c in self._combinations]
        rows = np.concatenate([np.eye(len(alone))[alone], *map(np.atleast_2d, gradients)])
        if np.linalg.matrix_rank(rows / _lengths(rows)) + len(ties.directions) < len(alone):
            alone, self._combinations, rows = np.ones_like(alone), (), np.eye(len(alone))
        self._alone = alone
        self._back = np.linalg.pinv(rows / _lengths(rows)) / _lengths(rows).T

    def coordinates(self, chromosome: FloatArray) -> FloatArray:
        """Search coordinates, (n_free,), whose differences are the least that show as much."""
        there = named_values(self._space, chromosome)
        combined = [change(c, self._here, there) for c in self._combinations]
        shown = np.array([*self._space.encode(chromosome)[self._alone], *combined])
        with np.errstate(invalid="ignore"):  # where what divides in a combination is zero
            coordinates: FloatArray = self._back @ shown
        return coordinates


def _lengths(rows: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(rows, axis=1, keepdims=True)
    return lengths


def change(combination: Invariant, here: Mapping[str, float], there: Mapping[str, float]) -> float:
    """Change of a combination between parameters by name, of a positive one as of its logarithm."""
    before, after = combination.value(here), combination.value(there)
    positive = min(before, after) > 0.0
    return float(before * np.log(after / before) if positive else after - before)


def ties(sensitivity: Sensitivity) -> Ties:
    """What the model's equations leave undetermined; nothing if they cannot be followed."""
    objective = sensitivity.objective
    space, model = objective.space, _as_searched(objective.simulator.model, objective.space)
    counted = np.flatnonzero(objective.weights > 0.0)
    try:
        shown = model.with_outputs([model.output_names[j] for j in counted])
        result = kept_identifiability(shown)
    except (ModelError, ArithmeticError):
        return Ties(np.zeros((0, len(space.names))))
    combinations = [
        renamed
        for group in result.tied
        for combination in group.combinations
        for renamed in _of_each_record(combination, space)
    ]
    members = {name for group in result.tied for name in group.parameters}
    if any(len(group.combinations) < group.count for group in result.tied) and not space.ties:
        tied = Ties(_directions(sensitivity, model), combinations)
    else:
        tied = Ties.of(space, sensitivity.chromosome, combinations, members)
    if not len(tied.directions):
        return tied
    # What a start without exception leaves alone may act where a log has gone since.
    return replace(tied, directions=tied.directions[~_felt(sensitivity, tied.directions)])


def _felt(sensitivity: Sensitivity, directions: FloatArray) -> BoolArray:
    """Which directions (n, n_free) move the outputs of these data all the same, (n,)."""
    apart = np.abs(directions) * np.linalg.norm(sensitivity.rows, axis=0)
    counted = sensitivity.objective.weights > 0.0
    slopes = slopes_along(sensitivity, directions)[:, counted]
    together = np.linalg.norm(slopes, axis=(0, 1))  # no number where a simulation fails
    felt: BoolArray = together > _FELT * apart.max(axis=1, initial=0.0)
    return felt


def _directions(sensitivity: Sensitivity, model: ProcessModel) -> FloatArray:
    """Tied directions of the coordinates, where not all combinations have a name."""
    from sysid.identifiability import null_directions  # loads flint, and is seldom needed

    space, chromosome = sensitivity.objective.space, sensitivity.chromosome
    states = dict.fromkeys(model.state_names[i] for _, i in space.estimated)
    n = len(space.index)
    starts = chromosome[n:].reshape(-1, len(states)) if states else None
    basis = null_directions(model, space.full(chromosome), space.names[:n], tuple(states), starts)
    directions: FloatArray = basis / sensitivity.increments
    return directions


def _as_searched(model: ProcessModel, space: SearchSpace) -> ProcessModel:
    """The model with what is not searched fixed at its value, and the ranges searched."""
    changes: dict[str, dict[str, Any]] = {
        parameter.name: {"nominal": float(value), "fixed": True}
        for parameter, value in zip(model.parameters, space.base, strict=True)
    }
    for tie in space.ties:
        changes[model.parameter_names[tie.index]] = {"fixed": False}
    for parameter in space.parameters[: len(space.index)]:
        changes[parameter.name] = {
            "nominal": parameter.nominal,
            "lower": parameter.lower,
            "upper": parameter.upper,
            "scale": parameter.scale,
            "fixed": False,
        }
    return model.with_parameters(**changes)


def named_values(space: SearchSpace, chromosome: FloatArray) -> dict[str, float]:
    """All the model's parameters, and the starts that are estimated, by name."""
    columns = named_columns(space, chromosome[None])
    return {name: float(values[0]) for name, values in columns.items()}


def named_columns(space: SearchSpace, chromosomes: FloatArray) -> dict[str, FloatArray]:
    """The same of chromosomes (n, n_free), (n,) each."""
    columns = [*space.full(chromosomes).T, *chromosomes.T]
    return dict(zip((*space.model.parameter_names, *space.names), columns, strict=True))


def free_gradient(
    combination: Invariant, space: SearchSpace, values: Mapping[str, float]
) -> FloatArray:
    """Derivatives of a combination by the free parameters, those tied to them moving along."""
    gradient = np.zeros(len(space.names))
    factors = {space.model.parameter_names[tie.index]: tie for tie in space.ties}
    for name, slope in combination.gradient(values).items():
        tie = factors.get(name)
        factor = 1.0 if tie is None else tie.factor
        source = name if tie is None else space.model.parameter_names[tie.source]
        if source in space.names:
            gradient[space.names.index(source)] += factor * slope
    return gradient


def coded_gradient(
    combination: Invariant, space: SearchSpace, chromosome: FloatArray
) -> FloatArray:
    """The same by the search coordinates, at a chromosome, (n_free,) both."""
    gradient = free_gradient(combination, space, named_values(space, chromosome))
    return gradient * np.where(space.log, chromosome, 1.0)


@dataclass(frozen=True)
class _Renamed:
    """A combination whose starts are those of one record of several."""

    combination: Invariant
    starts: Mapping[str, str]

    @property
    def text(self) -> str:
        text = self.combination.text
        for name, start in self.starts.items():
            text = text.replace(name, start)
        return text

    @property
    def unit(self) -> str:
        return self.combination.unit

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.starts.get(name, name) for name in self.combination.names)

    def value(self, values: Mapping[str, float]) -> float:
        return self.combination.value(self._as_declared(values))

    def gradient(self, values: Mapping[str, float]) -> dict[str, float]:
        slopes = self.combination.gradient(self._as_declared(values))
        return {self.starts.get(name, name): slope for name, slope in slopes.items()}

    def _as_declared(self, values: Mapping[str, float]) -> dict[str, float]:
        names = self.combination.names
        return {name: values[self.starts.get(name, name)] for name in names}


def _of_each_record(combination: Invariant, space: SearchSpace) -> list[Invariant]:
    """The combination, or if starts are in it that of each record's starts."""
    estimated = {f"{space.model.states[i].name}(0)" for _, i in space.estimated}
    starts = [name for name in combination.names if name in estimated]
    if not starts or set(starts) <= set(space.names):
        return [combination]
    records = sorted({record for record, _ in space.estimated})
    each = [{name: f"{name} {record + 1}" for name in starts} for record in records]
    return [
        _Renamed(combination, names) for names in each if set(names.values()) <= set(space.names)
    ]


def _sparse(basis: FloatArray) -> FloatArray:
    """The same space spanned by rows with as many zeros as elimination gives."""
    rows = basis.copy()
    left = list(range(len(rows)))
    while left:
        pivot = np.unravel_index(int(np.argmax(np.abs(rows[left]))), (len(left), rows.shape[1]))
        row, column = left.pop(int(pivot[0])), int(pivot[1])
        rows[row] /= rows[row, column]
        rest = [i for i in range(len(rows)) if i != row]
        rows[rest] -= np.outer(rows[rest, column], rows[row])
    rows[np.abs(rows) < _NOTHING] = 0.0
    return rows
