"""Which parameters are searched, where, and on which scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, Parameter, ProcessModel, Scale
from sysid.problem.ranges import Range, Tie, one_sided, searched, ties

# A search value this close to an end of its range, in parts of the range, stands on it.
_ON_BOUND = 1e-3


@dataclass(frozen=True)
class Start:
    """A state whose initial value is estimated, and the record whose it is."""

    record: int
    state: int


@dataclass(frozen=True)
class SearchSpace:
    """The free parameters of a model between their ranges; the rest stay fixed.

    A chromosome is a row of free parameters in their own units, (n_free,), behind which stand
    the initial states that are estimated, record by record. ``encode`` maps it to search
    coordinates (logarithm where the scale is log), ``decode`` back.

    lower, upper: where the search starts. hard_lower, hard_upper: what it keeps within; for a
    range with one end given these are that end and the physical limit, else lower and upper.
    """

    model: ProcessModel
    parameters: tuple[Parameter, ...]
    base: FloatArray
    index: tuple[int, ...]
    estimated: tuple[Start, ...] = ()
    ties: tuple[Tie, ...] = ()
    one_sided: frozenset[str] = frozenset()

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
        """Space from the model's own ranges and what is said in their place.

        ranges: {name: (low, high)}, frees a parameter; either end may be None. fixed: {name:
        value}. tied: {name: "0.5 * other"}. scale: {name: "log" or "linear"}; use_log: whether
        the model's own log scales count. Raises ModelError for an unknown name, a bad range,
        contradictions, or when nothing is left to search.
        """
        ranges, fixed = dict(ranges or {}), dict(fixed or {})
        tied, scale = dict(tied or {}), dict(scale or {})
        for name in (*ranges, *fixed, *tied, *scale):
            model.parameter(name)
        _check_conflicts(ranges, fixed, tied, scale)
        for name, value in fixed.items():
            replace(model.parameter(name), nominal=value, fixed=True)  # checks the value
        followers = ties(model, tied)
        free, index = [], []
        for i, parameter in enumerate(model.parameters):
            name = parameter.name
            if name in fixed or name in tied or (parameter.fixed and name not in ranges):
                if name in scale:
                    raise ModelError(f"parameter {name} has a scale but is not searched; free it "
                                     "with a range, or leave the scale out")  # fmt: skip
                continue
            own = parameter if use_log else replace(parameter, scale="linear")
            free.append(searched(own, ranges.get(name), scale.get(name)))
            index.append(i)
        if not free:
            raise ModelError(f"model {model.name}: every parameter is fixed; free at least one")
        open_ended = frozenset(name for name, given in ranges.items() if one_sided(given))
        space = cls(
            model, tuple(free), model.vector(fixed), tuple(index),
            ties=followers, one_sided=open_ended,
        )  # fmt: skip
        space._check_ties()
        return space

    @classmethod
    def of_starts(cls, model: ProcessModel, vector: FloatArray, record: Dataset) -> SearchSpace:
        """Only the initial states of a record, the model's parameters being ``vector``."""
        return cls(model, (), np.asarray(vector), ()).with_starts([record])

    def with_starts(self, records: Sequence[Dataset]) -> SearchSpace:
        """The same space and the initial states that are to be estimated, record by record."""
        parameters, starts = list(self.parameters), list(self.estimated)
        for k, record in enumerate(records):
            own = record.initial_state(self.model)
            for i, state in enumerate(self.model.states):
                ends = record.initial_range(self.model, i)
                if ends is None:
                    continue
                name = f"{state.name}(0)" if len(records) == 1 else f"{state.name}(0) {k + 1}"
                about = f"initial {state.description or state.name}"
                begin = min(max(float(own[i]), ends[0]), ends[1])
                parameters.append(
                    Parameter(name, state.unit, begin, *ends, minimum=-np.inf, description=about)
                )
                starts.append(Start(k, i))
        return replace(self, parameters=tuple(parameters), estimated=tuple(starts))

    def with_nominal_starts(self, chromosomes: FloatArray) -> FloatArray:
        """Chromosomes of the parameters alone, completed by where the states start otherwise."""
        begin = [parameter.nominal for parameter in self.parameters[len(self.index) :]]
        return np.concatenate(
            [chromosomes, np.broadcast_to(begin, (*chromosomes.shape[:-1], len(begin)))], axis=-1
        )

    def starts(self, chromosomes: FloatArray, record: int, own: FloatArray) -> FloatArray:
        """Initial states of one record for each chromosome, (n, n_states).

        own: (n_states,), those that the record and the model themselves give.
        """
        states = np.repeat(own[None], len(chromosomes), axis=0)
        for place, start in enumerate(self.estimated, len(self.index)):
            if start.record == record:
                states[:, start.state] = chromosomes[:, place]
        return states

    def named_starts(self, chromosome: FloatArray) -> list[dict[str, float]]:
        """The estimated initial states in a chromosome (n_free,), by state, for each record."""
        found: list[dict[str, float]] = []
        for place, start in enumerate(self.estimated, len(self.index)):
            found += [{} for _ in range(start.record + 1 - len(found))]
            found[start.record][self.model.states[start.state].name] = float(chromosome[place])
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def lower(self) -> FloatArray:
        """Low ends of the ranges, (n_free,)."""
        return _constant([parameter.lower for parameter in self.parameters])

    @cached_property
    def upper(self) -> FloatArray:
        """High ends of the ranges, (n_free,)."""
        return _constant([parameter.upper for parameter in self.parameters])

    @cached_property
    def coded_lower(self) -> FloatArray:
        """Low ends of the ranges in search coordinates, (n_free,)."""
        return _constant(self.encode(self.lower))

    @cached_property
    def width(self) -> FloatArray:
        """Widths of the ranges in search coordinates, (n_free,)."""
        return _constant(self.encode(self.upper) - self.encode(self.lower))

    @property
    def hard_lower(self) -> FloatArray:
        """Low ends that the search keeps to, (n_free,); -inf where there is none."""
        # A logarithm cannot pass zero, wherever the physical limit is.
        least = np.where(self.log, np.maximum(self.minimum, 0.0), self.minimum)
        return np.where(self._open_ended, least, self.lower)

    @property
    def hard_upper(self) -> FloatArray:
        """High ends that the search keeps to, (n_free,); inf where there is none."""
        return np.where(self._open_ended, self.maximum, self.upper)

    @cached_property
    def coded_bounds(self) -> tuple[FloatArray, FloatArray]:
        """``hard_lower`` and ``hard_upper`` in search coordinates, (n_free,) each."""
        with np.errstate(divide="ignore"):  # the logarithm of zero is the bound -inf
            ends = self.encode(self.hard_lower), self.encode(self.hard_upper)
        return _constant(ends[0]), _constant(ends[1])

    def on_bound(self, chromosome: FloatArray) -> BoolArray:
        """Which values of a chromosome (n_free,) stand on a bound of their range."""
        lower, upper = self.coded_bounds
        near = _ON_BOUND * self.width
        at = self.encode(chromosome)
        mask: BoolArray = (at < lower + near) | (at > upper - near)
        return mask

    @cached_property
    def minimum(self) -> FloatArray:
        """Physical minima, (n_free,)."""
        return _constant([parameter.minimum for parameter in self.parameters])

    @cached_property
    def maximum(self) -> FloatArray:
        """Physical maxima, (n_free,)."""
        return _constant([parameter.maximum for parameter in self.parameters])

    @cached_property
    def log(self) -> BoolArray:
        """Mask of the parameters searched by logarithm, (n_free,)."""
        mask = np.array([parameter.scale == "log" for parameter in self.parameters], dtype=bool)
        mask.setflags(write=False)
        return mask

    @cached_property
    def _places(self) -> IntArray:
        """Where the free parameters stand in a complete vector."""
        return np.array(self.index, dtype=np.int64)

    @property
    def _open_ended(self) -> BoolArray:
        return np.array([parameter.name in self.one_sided for parameter in self.parameters], bool)

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

    def full(self, chromosomes: FloatArray) -> FloatArray:
        """Complete parameter vectors of chromosomes, (..., n_parameters)."""
        chromosomes = np.asarray(chromosomes)
        vectors = np.empty((*chromosomes.shape[:-1], len(self.base)))
        vectors[:] = self.base
        vectors[..., self._places] = chromosomes[..., : len(self.index)]
        for tie in self.ties:
            vectors[..., tie.index] = tie.factor * vectors[..., tie.source]
        return vectors

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
        rows.append(self._constraints_of(vectors))
        violations = np.maximum(0.0, np.concatenate(rows, axis=1))
        # Not-a-number is no proof of feasibility.
        return np.where(np.isnan(violations), np.inf, violations)

    def constraint_values(self, chromosomes: FloatArray) -> FloatArray:
        """The model's constraints g, satisfied where not above 0, (n_chromosomes, n)."""
        return self._constraints_of(self.full(chromosomes))

    def _constraints_of(self, vectors: FloatArray) -> FloatArray:
        columns = tuple(vectors.T)
        values = np.zeros((len(vectors), len(self.model.constraints)))
        for i, constraint in enumerate(self.model.constraints):
            values[:, i] = constraint.function(columns)
        return values


@dataclass(frozen=True)
class HeldSpace(SearchSpace):
    """A space in which one coordinate keeps its value."""

    place: int = 0
    value: float = 0.0

    @classmethod
    def holding(cls, space: SearchSpace, place: int, value: float) -> HeldSpace:
        """The space with one search coordinate held."""
        given = {f.name: getattr(space, f.name) for f in fields(SearchSpace)}
        return cls(**given, place=place, value=value)

    @cached_property
    def coded_bounds(self) -> tuple[FloatArray, FloatArray]:
        """As of the whole space, but both at the held value."""
        lower, upper = (ends.copy() for ends in super().coded_bounds)
        lower[self.place] = upper[self.place] = self.value
        return lower, upper


def _constant(values: Sequence[float] | FloatArray) -> FloatArray:
    """An array that several may hold because nobody can change it."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _check_conflicts(*groups: Mapping[str, object]) -> None:
    """Raise ModelError where a parameter has been said to be two things."""
    ranges, fixed, tied, scale = groups
    pairs = (
        (ranges, fixed, "both a range and a fixed value"),
        (ranges, tied, "a range but is tied to another"),
        (fixed, tied, "a fixed value but is tied to another"),
        (scale, fixed, "a scale but is fixed"),
        (scale, tied, "a scale but is tied to another"),
    )
    for one, other, what in pairs:
        both = sorted(set(one) & set(other))
        if both:
            raise ModelError(f"parameter {both[0]} has {what}; keep one")
