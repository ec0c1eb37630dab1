"""Which parameters are searched, where, and on which scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sysid.model import BoolArray, FloatArray, ModelError, Parameter, ProcessModel, check_range


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
    """

    model: ProcessModel
    parameters: tuple[Parameter, ...]
    base: FloatArray
    index: tuple[int, ...]
    use_log: bool = True
    estimated: tuple[Start, ...] = ()

    @classmethod
    def of(
        cls,
        model: ProcessModel,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        fixed: Mapping[str, float] | None = None,
        use_log: bool = True,
    ) -> SearchSpace:
        """Space from the model's own ranges, overridden by ``ranges`` and ``fixed``.

        A parameter given a range becomes free; one given a value becomes fixed. Raises
        ModelError for an unknown name, a bad range, or when nothing is left to search.
        """
        ranges, fixed = dict(ranges or {}), dict(fixed or {})
        for name in (*ranges, *fixed):
            model.parameter(name)
        both = sorted(set(ranges) & set(fixed))
        if both:
            raise ModelError(f"parameter {both[0]} has both a range and a fixed value; keep one")
        for name, value in fixed.items():
            replace(model.parameter(name), nominal=value, fixed=True)  # checks the value
        base = model.vector(fixed)
        free, index = [], []
        for i, parameter in enumerate(model.parameters):
            if parameter.name in fixed or (parameter.fixed and parameter.name not in ranges):
                continue
            lower, upper = ranges.get(parameter.name, (parameter.lower, parameter.upper))
            # A range that touches zero cannot be searched by logarithm.
            scale = parameter.scale if lower > 0.0 else "linear"
            check_range(parameter.name, lower, upper, scale)
            _check_limits(parameter, lower, upper)
            nominal = min(max(parameter.nominal, parameter.minimum), parameter.maximum)
            free.append(
                Parameter(
                    parameter.name,
                    parameter.unit,
                    nominal,
                    lower,
                    upper,
                    scale,
                    False,
                    parameter.minimum,
                    parameter.maximum,
                    parameter.description,
                )
            )
            index.append(i)
        if not free:
            raise ModelError(f"model {model.name}: every parameter is fixed; free at least one")
        return cls(model, tuple(free), base, tuple(index), use_log)

    @classmethod
    def of_starts(cls, model: ProcessModel, vector: FloatArray, n_records: int) -> SearchSpace:
        """Only the initial states of some records, the model's parameters being ``vector``."""
        return cls(model, (), np.asarray(vector), ()).with_starts(n_records)

    def with_starts(self, n_records: int) -> SearchSpace:
        """The same space and the initial states that the model leaves to be estimated."""
        parameters, starts = list(self.parameters), list(self.estimated)
        for record in range(n_records):
            for i, state in enumerate(self.model.states):
                if state.initial_range is None:
                    continue
                name = f"{state.name}(0)" if n_records == 1 else f"{state.name}(0) {record + 1}"
                low, high = state.initial_range
                about = f"initial {state.description or state.name}"
                parameters.append(
                    Parameter(
                        name, state.unit, state.initial, low, high,
                        minimum=-np.inf, description=about,
                    )
                )  # fmt: skip
                starts.append(Start(record, i))
        return replace(self, parameters=tuple(parameters), estimated=tuple(starts))

    def with_declared_starts(self, chromosomes: FloatArray) -> FloatArray:
        """Chromosomes of the parameters alone, completed by the declared initial states."""
        declared = [self.model.states[start.state].initial for start in self.estimated]
        return np.concatenate(
            [chromosomes, np.broadcast_to(declared, (*chromosomes.shape[:-1], len(declared)))],
            axis=-1,
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

    @property
    def lower(self) -> FloatArray:
        """Low ends of the ranges, (n_free,)."""
        return np.array([parameter.lower for parameter in self.parameters])

    @property
    def upper(self) -> FloatArray:
        """High ends of the ranges, (n_free,)."""
        return np.array([parameter.upper for parameter in self.parameters])

    @property
    def minimum(self) -> FloatArray:
        """Physical minima, (n_free,)."""
        return np.array([parameter.minimum for parameter in self.parameters])

    @property
    def maximum(self) -> FloatArray:
        """Physical maxima, (n_free,)."""
        return np.array([parameter.maximum for parameter in self.parameters])

    @property
    def log(self) -> BoolArray:
        """Mask of the parameters searched by logarithm, (n_free,)."""
        flags = [self.use_log and parameter.scale == "log" for parameter in self.parameters]
        return np.array(flags, dtype=bool)

    def encode(self, chromosomes: FloatArray) -> FloatArray:
        """Search coordinates of chromosomes, (..., n_free)."""
        coded = np.array(chromosomes, dtype=np.float64)
        coded[..., self.log] = np.log(coded[..., self.log])
        return coded

    def decode(self, coded: FloatArray) -> FloatArray:
        """Chromosomes of search coordinates, (..., n_free)."""
        chromosomes = np.array(coded, dtype=np.float64)
        chromosomes[..., self.log] = np.exp(chromosomes[..., self.log])
        return chromosomes

    def full(self, chromosomes: FloatArray) -> FloatArray:
        """Complete parameter vectors of chromosomes, (..., n_parameters)."""
        chromosomes = np.asarray(chromosomes)
        vectors = np.broadcast_to(self.base, (*chromosomes.shape[:-1], len(self.base))).copy()
        vectors[..., list(self.index)] = chromosomes[..., : len(self.index)]
        return vectors

    def violations(self, chromosomes: FloatArray) -> FloatArray:
        """Inequality violations max(0, g) of (4.15), (n_chromosomes, n_constraints).

        First the physical limits of each free parameter, then the model's constraints.
        """
        vectors = self.full(chromosomes)
        columns = tuple(vectors[:, i] for i in range(vectors.shape[1]))
        below = np.maximum(0.0, self.minimum - chromosomes)
        above = np.maximum(0.0, chromosomes - self.maximum)
        rows = [below, above]
        for constraint in self.model.constraints:
            values = np.broadcast_to(constraint.function(columns), (len(chromosomes),))
            rows.append(np.maximum(0.0, values)[:, None])
        violations = np.concatenate(rows, axis=1)
        # Not-a-number is no proof of feasibility.
        return np.where(np.isnan(violations), np.inf, violations)


def _check_limits(parameter: Parameter, lower: float, upper: float) -> None:
    if lower < parameter.minimum or upper > parameter.maximum:
        raise ModelError(
            f"parameter {parameter.name}: range [{lower:g}, {upper:g}] leaves what is physically "
            f"possible, [{parameter.minimum:g}, {parameter.maximum:g}]"
        )
