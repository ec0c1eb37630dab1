"""Which parameters are searched, where, and on which scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.problem.data import Dataset
from sysid.problem.model import Function, ModelError, Parameter, ProcessModel, Scale
from sysid.problem.ranges import Range, Tie, ties, with_search_range
from sysid.time_limit import AT_A_POINT, time_limit

# A search coordinate this close to an end of its range, in parts of the range, stands on it.
ON_BOUND = 1e-3


@dataclass(frozen=True)
class SearchSpace:
    """The free parameters of a model between their ranges; the rest stay fixed.

    A chromosome is a row of free parameters in their units, (n_free,), behind which stand the
    initial states that are estimated, record by record. ``encode`` maps it to search coordinates
    (logarithm where the scale is log), ``decode`` back.

    lower, upper: where the search starts. minimum, maximum: physical limits. hard_lower,
    hard_upper: what the search keeps within; for a range with one end given these are that end
    and the physical limit, else lower and upper. log: mask of the parameters searched by
    logarithm. coded_lower, width: low ends and widths in search coordinates. All (n_free,).
    estimated: record and state of each initial state that is estimated, by their places.
    one_sided: names of the parameters with one end given.

    >>> from sysid.examples import lag
    >>> space = SearchSpace.of(lag(), ranges={"gain": (1.0, 4.0)}, fixed={"tau": 0.1})
    >>> space.names, space.full(np.array([2.5])).tolist()
    (('gain',), [2.5, 0.1])
    """

    model: ProcessModel
    parameters: tuple[Parameter, ...]
    base: FloatArray
    index: tuple[int, ...]
    estimated: tuple[tuple[int, int], ...] = ()
    ties: tuple[Tie, ...] = ()
    one_sided: frozenset[str] = frozenset()
    lower: FloatArray = field(init=False, repr=False, compare=False)
    upper: FloatArray = field(init=False, repr=False, compare=False)
    minimum: FloatArray = field(init=False, repr=False, compare=False)
    maximum: FloatArray = field(init=False, repr=False, compare=False)
    hard_lower: FloatArray = field(init=False, repr=False, compare=False)
    hard_upper: FloatArray = field(init=False, repr=False, compare=False)
    log: BoolArray = field(init=False, repr=False, compare=False)
    coded_lower: FloatArray = field(init=False, repr=False, compare=False)
    width: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "minimum", "maximum"):
            self._keep(name, np.array([getattr(p, name) for p in self.parameters], np.float64))
        self._keep("log", np.array([p.scale == "log" for p in self.parameters], bool))
        open_ended = np.array([p.name in self.one_sided for p in self.parameters], bool)
        # A logarithm cannot pass zero, wherever the physical limit is.
        least = np.where(self.log, np.maximum(self.minimum, 0.0), self.minimum)
        self._keep("hard_lower", np.where(open_ended, least, self.lower))
        self._keep("hard_upper", np.where(open_ended, self.maximum, self.upper))
        self._keep("coded_lower", self.encode(self.lower))
        self._keep("width", self.encode(self.upper) - self.coded_lower)

    def _keep(self, name: str, values: npt.NDArray[Any]) -> None:
        values.setflags(write=False)
        object.__setattr__(self, name, values)

    @classmethod
    def of(
        cls,
        model: ProcessModel,
        ranges: Mapping[str, Range] | None = None,
        fixed: Mapping[str, float] | None = None,
        use_log: bool = True,
        *,
        tied: Mapping[str, str] | None = None,
        scale: Mapping[str, Scale] | None = None,
    ) -> SearchSpace:
        """Space from the model's declared ranges and what is given in their place.

        ranges: {name: (low, high)}, frees a parameter; either end may be None. fixed: {name:
        value}. tied: {name: "0.5 * other"}. scale: {name: "log" or "linear"}; use_log: whether
        the model's log scales count. Raises ModelError for an unknown name, a bad range,
        contradictions, or when nothing is left to search.
        """
        ranges, fixed = dict(ranges or {}), dict(fixed or {})
        tied, scale = dict(tied or {}), dict(scale or {})
        for name in (*ranges, *fixed, *tied, *scale):
            model.parameter(name)
        _check_conflicts(ranges, fixed, tied, scale)
        for name, value in fixed.items():
            replace(model.parameter(name), nominal=value, fixed=True)  # checks the value
        resolved = ties(model, tied)
        free: dict[int, Parameter] = {}
        for i, parameter in enumerate(model.parameters):
            name = parameter.name
            if name not in fixed and name not in tied and (name in ranges or not parameter.fixed):
                declared = parameter if use_log else replace(parameter, scale="linear")
                free[i] = with_search_range(declared, ranges.get(name), scale.get(name))
            elif name in scale:
                raise ModelError(
                    f"parameter {name} has a scale but is not searched; free it with a range, or "
                    "leave the scale out"
                )
        if not free:
            raise ModelError(f"model {model.name}: every parameter is fixed; free at least one")
        parameters, base = tuple(free.values()), model.vector(fixed)
        one_sided = frozenset(name for name, ends in ranges.items() if ends and None in ends)
        space = cls(model, parameters, base, tuple(free), ties=resolved, one_sided=one_sided)
        space._check_ties()
        return space

    @classmethod
    def of_starts(cls, model: ProcessModel, vector: FloatArray, record: Dataset) -> SearchSpace:
        """Only the initial states of a record, the model's parameters being ``vector``."""
        return cls(model, (), np.asarray(vector), ()).with_starts([record])

    def with_starts(self, records: Sequence[Dataset]) -> SearchSpace:
        """The same space with the initial states that are estimated, record by record."""
        parameters, starts = list(self.parameters), list(self.estimated)
        for k, record in enumerate(records):
            initial = record.initial_state(self.model)
            for i, state in enumerate(self.model.states):
                ends = record.initial_range(self.model, i)
                if ends is None:
                    continue
                name = f"{state.name}(0)" if len(records) == 1 else f"{state.name}(0) {k + 1}"
                about = f"initial {state.description or state.name}"
                begin = min(max(float(initial[i]), ends[0]), ends[1])
                parameters.append(
                    Parameter(name, state.unit, begin, *ends, minimum=-np.inf, description=about)
                )
                starts.append((k, i))
        return replace(self, parameters=tuple(parameters), estimated=tuple(starts))

    def without_starts(self) -> SearchSpace:
        """The same space of the parameters alone."""
        return replace(self, parameters=self.parameters[: len(self.index)], estimated=())

    def of_record(self, place: int) -> SearchSpace:
        """The same space for that record alone; starts of the others move nothing."""
        estimated = tuple((record - place, state) for record, state in self.estimated)
        return replace(self, estimated=estimated)

    def starts_by_record(self, n_records: int) -> list[list[tuple[int, int]]]:
        """Coordinate and state of each estimated initial state, for each of the records."""
        starts: list[list[tuple[int, int]]] = [[] for _ in range(n_records)]
        for column, (record, state) in enumerate(self.estimated, len(self.index)):
            if 0 <= record < n_records:
                starts[record].append((column, state))
        return starts

    def with_nominal_starts(self, chromosomes: FloatArray) -> FloatArray:
        """Chromosomes of the parameters alone, completed by where the states start otherwise."""
        begin = [parameter.nominal for parameter in self.parameters[len(self.index) :]]
        return np.concatenate(
            [chromosomes, np.broadcast_to(begin, (*chromosomes.shape[:-1], len(begin)))], axis=-1
        )

    def starts(self, chromosomes: FloatArray, record: int, declared: FloatArray) -> FloatArray:
        """Initial states of a record for each chromosome, (n, n_states).

        declared: (n_states,), initial states of those that are not estimated.
        """
        states = np.repeat(declared[None], len(chromosomes), axis=0)
        columns = chromosomes.T[len(self.index) :]
        for (number, state), values in zip(self.estimated, columns, strict=True):
            if number == record:
                states[:, state] = values
        return states

    def named_starts(self, chromosome: FloatArray) -> list[dict[str, float]]:
        """The estimated initial states in a chromosome (n_free,), by state, for each record."""
        last = max((record for record, _ in self.estimated), default=-1)
        named: list[dict[str, float]] = [{} for _ in range(last + 1)]
        for (record, i), value in zip(self.estimated, chromosome[len(self.index) :], strict=True):
            named[record][self.model.states[i].name] = float(value)
        return named

    def as_model(self) -> ProcessModel:
        """The model whose free parameters are those searched, the tied ones in its equations."""
        free = dict(zip(self.index, self.parameters, strict=False))
        rest = zip(self.model.parameters, self.base.tolist(), strict=True)
        parameters = [
            free.get(i) or replace(p, nominal=value, fixed=True)
            for i, (p, value) in enumerate(rest)
        ]
        derivative = _with_ties(self.model.derivative, self.ties)
        output = self.model.output and _with_ties(self.model.output, self.ties)
        return replace(
            self.model, parameters=tuple(parameters), derivative=derivative, output=output
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def coded_bounds(self) -> tuple[FloatArray, FloatArray]:
        """``hard_lower`` and ``hard_upper`` in search coordinates, (n_free,) each."""
        with np.errstate(divide="ignore"):  # the logarithm of zero is the bound -inf
            lower, upper = self.encode(self.hard_lower), self.encode(self.hard_upper)
        lower.setflags(write=False)
        upper.setflags(write=False)
        return lower, upper

    def on_bound(self, chromosome: FloatArray) -> BoolArray:
        """Which values of a chromosome (n_free,) stand on a bound of their range."""
        lower, upper = self.coded_bounds
        near = ON_BOUND * self.width
        at = self.encode(chromosome)
        return (at < lower + near) | (at > upper - near)

    def encode(self, chromosomes: FloatArray) -> FloatArray:
        """Search coordinates of chromosomes, (..., n_free)."""
        coded = np.array(chromosomes, dtype=np.float64)
        coded[..., self.log] = np.log(coded[..., self.log])
        return coded

    def decode(self, coded: FloatArray) -> FloatArray:
        """Chromosomes of search coordinates, (..., n_free)."""
        chromosomes = np.array(coded, dtype=np.float64)
        with np.errstate(over="ignore"):  # beyond an open end there is no limit
            chromosomes[..., self.log] = np.exp(chromosomes[..., self.log])
        return chromosomes

    def _check_ties(self) -> None:
        """Raise ModelError for a tie that nowhere gives a physically possible value."""
        low, high = self.full(self.lower), self.full(self.upper)
        for tie in self.ties:
            parameter = self.model.parameters[tie.index]
            ends = sorted((low[tie.index], high[tie.index]))
            if ends[1] < parameter.minimum or ends[0] > parameter.maximum:
                raise ModelError(
                    f"parameter {parameter.name}: tied to "
                    f"{self.model.parameter_names[tie.source]} it would be {ends[0]:g} .. "
                    f"{ends[1]:g}, outside its physical limits [{parameter.minimum:g}, "
                    f"{parameter.maximum:g}]"
                )

    @cached_property
    def _places(self) -> IntArray:
        return np.array(self.index, dtype=np.int64)

    def full(self, chromosomes: FloatArray) -> FloatArray:
        """Complete parameter vectors of chromosomes, (..., n_parameters)."""
        chromosomes = np.asarray(chromosomes)
        vectors = np.empty((*chromosomes.shape[:-1], len(self.base)))
        vectors[:] = self.base
        vectors[..., self._places] = chromosomes[..., : len(self.index)]
        for tie in self.ties:
            vectors[..., tie.index] = tie.factor * vectors[..., tie.source]
        return vectors

    def directions(self, chromosomes: FloatArray) -> FloatArray:
        """How parameters move with each search coordinate, (n, n_coordinates, n_parameters).

        Of the coordinates of parameters, in their order; starts move none.
        """
        n = len(self.index)
        increments = np.where(self.log[:n], chromosomes[:, :n], 1.0)
        directions = np.zeros((len(chromosomes), n, len(self.base)))
        for k, place in enumerate(self.index):
            directions[:, k, place] = increments[:, k]
        for tie in self.ties:
            directions[:, :, tie.index] = tie.factor * directions[:, :, tie.source]
        return directions

    def feasible(self, chromosome: FloatArray) -> bool:
        """Whether all limits and constraints hold of a chromosome, (n_free,)."""
        return bool(np.all(self.violations(chromosome[None]) <= 0.0))

    def violations(self, chromosomes: FloatArray) -> FloatArray:
        """Inequality violations max(0, g) of (4.15), (n_chromosomes, n_constraints).

        First the physical limits of each free parameter, then those of the tied ones, then the
        model's constraints.
        """
        vectors = self.full(chromosomes)
        rows = [self.minimum - chromosomes, chromosomes - self.maximum]
        for tie in self.ties:
            parameter, values = self.model.parameters[tie.index], vectors[:, tie.index]
            rows.append(np.maximum(parameter.minimum - values, values - parameter.maximum)[:, None])
        rows.append(self._constraints_at(vectors))
        violations = np.maximum(0.0, np.concatenate(rows, axis=1))
        # Not-a-number is no proof of feasibility.
        return np.where(np.isnan(violations), np.inf, violations)

    def constraint_values(self, chromosomes: FloatArray) -> FloatArray:
        """The model's constraints g, satisfied where not above 0, (n_chromosomes, n)."""
        return self._constraints_at(self.full(chromosomes))

    def _constraints_at(self, vectors: FloatArray) -> FloatArray:
        constraints = self.model.constraints
        columns, values = tuple(vectors.T), np.zeros((len(vectors), len(constraints)))
        text = ""
        try:
            with time_limit(AT_A_POINT) if constraints else nullcontext():
                for i, constraint in enumerate(constraints):
                    text = constraint.text
                    values[:, i] = constraint.function(columns)
        except TimeoutError as error:
            raise ModelError(f"constraint {text!r}: {error}") from error
        return values


def _with_ties(function: Function, ties: Sequence[Tie]) -> Function:
    """A model's function that works out the tied parameters itself."""
    if not ties:
        return function

    def tied(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        values = list(p)
        for tie in ties:
            values[tie.index] = tie.factor * values[tie.source]
        return function(x, u, tuple(values))

    return tied


def _check_conflicts(*settings: Mapping[str, object]) -> None:
    """Raise ModelError for a parameter whose range, fixed value, tie and scale contradict."""
    ranges, fixed, tied, scale = settings
    pairs = (
        (ranges, fixed, "both a range and a fixed value"),
        (ranges, tied, "a range but is tied to another"),
        (fixed, tied, "a fixed value but is tied to another"),
        (scale, fixed, "a scale but is fixed"),
        (scale, tied, "a scale but is tied to another"),
    )
    for first, second, contradiction in pairs:
        conflicts = sorted(set(first) & set(second))
        if conflicts:
            raise ModelError(f"parameter {conflicts[0]} has {contradiction}; keep one")
