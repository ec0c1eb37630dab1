"""Parameters that outputs show only together: what of them is determined, what parts them."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.identifiability.directions import directions_at, telling_records
from sysid.identifiability.findings import Identifiability, TiedGroup
from sysid.identifiability.germ import Equations
from sysid.identifiability.invariants import Sample, combinations_of
from sysid.identifiability.points import PointSource
from sysid.identifiability.records import RecordPlan
from sysid.problem.expressions import measuring_effort
from sysid.problem.model import ModelError, ProcessModel

_FURTHER = 2  # points anywhere in the ranges, beside one near the nominal values
_ATTEMPTS = 4  # times as many points as are to be such that no more is tied than in general


@dataclass(frozen=True)
class _Place:
    """What is tied at a point: parameters (n_parameters,), values (n_columns,) of the free ones
    and the unknown starts, directions (k, n_columns).
    """

    parameters: FloatArray
    values: FloatArray
    directions: FloatArray
    gap: float


class Analysis:
    """Tied directions of one model, at as many points as it takes."""

    def __init__(self, model: ProcessModel, seed: int) -> None:
        self._model, self._rng = model, np.random.default_rng(seed)
        self._equations = Equations(model)
        self._points = PointSource(model, self._rng)
        self._free = [i for i, p in enumerate(model.parameters) if not p.fixed]
        self._unknown = [i for i, s in enumerate(model.states) if s.initial_range is not None]
        parameters = [model.parameters[i] for i in self._free]
        starts = [model.states[i] for i in self._unknown]
        self._names = [p.name for p in parameters] + [f"{s.name}(0)" for s in starts]
        units = [p.unit for p in parameters] + [s.unit for s in starts]
        self._units = dict(zip(self._names, units, strict=True))
        self._fixed = {p.name: p.nominal for p in model.parameters if p.fixed}
        if not self._names:
            raise ModelError(f"model {model.name}: every parameter is fixed; free at least one")
        # All points see the same records, so that each visits every branch of the equations.
        point = self._points.nearby()
        records = RecordPlan(self._equations, self._unknown, self._rng).records(point)
        self._records = telling_records(self._equations, point, self._free, records, self._rng)

    def result(self, with_sensors: bool) -> Identifiability:
        """The whole analysis, but for sensors where they are not asked for."""
        points = [self._points.nearby(), *(self._points.anywhere() for _ in range(_FURTHER))]
        # Where more is tied than elsewhere the point is an exception.
        places = [self._tied(self._equations, point, self._free) for point in points]
        place = min(places, key=lambda place: len(place.directions))
        moving = np.any(place.directions != 0.0, axis=0)
        groups = [
            sorted(group, key=self._effort)
            for group in _components(place.directions)
            if len(group) > 1
        ]
        grouped = set(itertools.chain(*groups))
        sensors = self._sensors(place.parameters) if groups and with_sensors else {}
        return Identifiability(
            self._model.output_names,
            tuple(self._model.state_names[i] for i in self._unknown),
            tuple(self._names[i] for i in np.flatnonzero(~moving)),
            tuple(self._group(group, place, sensors) for group in groups),
            tuple(self._names[i] for i in np.flatnonzero(moving) if i not in grouped),
            min(place.gap for place in places),
        )

    def _tied(self, equations: Equations, parameters: FloatArray, free: Sequence[int]) -> _Place:
        starts = [self._points.start(self._model.states[i]) for i in self._unknown]
        first, *others = self._records
        records = [first.started(starts, self._unknown), *others]
        tied = directions_at(equations, parameters, free, records, len(starts), self._rng)
        return _Place(parameters, np.array([*parameters[list(free)], *starts]), *tied)

    def _sensors(self, parameters: FloatArray) -> dict[str, BoolArray]:
        """What would be determined, by the further state that would be measured for it."""
        determined: dict[str, BoolArray] = {}
        for name in self._model.state_names:
            if name not in self._model.output_names:
                model = self._model.with_outputs((*self._model.output_names, name))
                place = self._tied(Equations(model), parameters, self._free)
                determined[name] = ~np.any(place.directions != 0.0, axis=0)
        return determined

    def _group(
        self, members: Sequence[int], place: _Place, sensors: Mapping[str, BoolArray]
    ) -> TiedGroup:
        names = tuple(self._names[i] for i in members)
        directions = _of_members(place.directions, members)
        count = len(members) - len(directions)
        samples: list[Sample] = []

        def sampled(n: int) -> list[Sample]:
            for _ in range(_ATTEMPTS * n):
                if len(samples) >= n:
                    return samples[:n]
                sample = self._sample(members)
                if len(sample.directions) == len(directions):
                    samples.append(sample)
            raise ArithmeticError("at most points more is tied")

        resolved = {
            state: tuple(self._names[i] for i in members if determined[i])
            for state, determined in sensors.items()
        }
        return TiedGroup(
            names,
            count,
            tuple(combinations_of(names, self._units, self._fixed, count, sampled)),
            directions,
            dict(zip(names, place.values[list(members)].tolist(), strict=True)),
            self._to_fix(names, directions),
            {state: parameters for state, parameters in resolved.items() if parameters},
        )

    def _sample(self, members: Sequence[int]) -> Sample:
        """How the members of a group are tied at another point."""
        n_free = len(self._free)
        free = [self._free[i] for i in members if i < n_free]
        place = self._tied(self._equations, self._points.nearby(), free)
        columns = [*range(len(free)), *(len(free) + i - n_free for i in members if i >= n_free)]
        return Sample(place.values[columns], _of_members(place.directions, columns))

    def _effort(self, column: int) -> tuple[bool, int]:
        """Rank by how easily it is measured, starts behind parameters."""
        is_start = column >= len(self._free)
        return is_start, measuring_effort(self._units[self._names[column]])

    @staticmethod
    def _to_fix(names: Sequence[str], directions: FloatArray) -> tuple[str, ...]:
        """Members that, held, leave no direction: the first that do."""
        scaled = directions / np.max(np.abs(directions), axis=0)
        fixed: list[int] = []
        for k in range(len(names)):
            if np.linalg.matrix_rank(scaled[:, [*fixed, k]], tol=1e-9) > len(fixed):
                fixed.append(k)
        return tuple(names[k] for k in fixed)


def _of_members(directions: FloatArray, members: Sequence[int]) -> FloatArray:
    """The directions in which some of the members move, (k, n_members)."""
    columns = directions[:, list(members)]
    moving: FloatArray = columns[np.any(columns != 0.0, axis=1)]
    return moving


def _components(basis: FloatArray) -> list[list[int]]:
    """Columns that hang together through rows in which they move."""
    groups: list[set[int]] = []
    for row in basis:
        group = set(np.flatnonzero(row).tolist())
        apart = [g for g in groups if not g & group]
        groups = [*apart, group.union(*(g for g in groups if g & group))]
    return sorted(map(sorted, groups))
