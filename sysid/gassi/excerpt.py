"""Parts of long records by which a search goes, before all of them are fitted.

A search takes thousands of simulations, and where minima lie a few thousand samples tell as well as
a long record. The parts are those whose channels and their changes vary most between them: the
determinant of the sum of their moments is made large, one part after the other (greedy
D-optimality, as in Fedorov, "Theory of optimal experiments", 1972, with the moments in place of a
model's information). Those of staircases are the ramps and steps, at every level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.problem.data import Dataset
from sysid.problem.space import SearchSpace

_LENGTH = 1024  # samples of a part
# Share of a part until what its start does not tell is forgotten: it is simulated, not compared.
_RUN_IN = 0.25
_RIDGE = 1e-3  # moments of channels that do not move, in parts of one that does


class Part(NamedTuple):
    """Rows from ``begin`` up to ``end`` of the record at a place."""

    place: int
    begin: int
    end: int


@dataclass(frozen=True)
class Excerpt:
    """Parts of records, those of each in order of time and the first from its first row."""

    records: Sequence[Dataset]
    parts: tuple[Part, ...]

    @classmethod
    def of(cls, records: Sequence[Dataset], samples: int) -> Excerpt | None:
        """An excerpt of about that many samples; None where it would not be half of all.

        Of a record as many parts as its share, one at least; a record shorter than two parts whole.
        """
        total = sum(record.n_samples for record in records)
        if samples == 0 or total <= 2 * samples:
            return None
        parts: list[Part] = []
        for place, record in enumerate(records):
            count = max(1, round(samples / _LENGTH * record.n_samples / total))
            whole = record.n_samples < 2 * _LENGTH
            begins = [0] if whole else _telling(record, count)
            end = record.n_samples if whole else _LENGTH
            parts += [Part(place, begin, begin + end) for begin in begins]
        excerpt = cls(tuple(records), tuple(parts))
        return excerpt if 2 * excerpt.n_samples < total else None

    @property
    def places(self) -> list[int]:
        """Which of the records each part is of."""
        return [part.place for part in self.parts]

    @property
    def n_samples(self) -> int:
        """Samples of all parts."""
        return sum(part.end - part.begin for part in self.parts)

    def datasets(self) -> list[Dataset]:
        """The parts as records; of one that begins later the first quarter is not compared."""
        return [self._dataset(*part) for part in self.parts]

    def _dataset(self, place: int, begin: int, end: int) -> Dataset:
        record = self.records[place]
        part = record.part(begin, end, f"{record.name}, rows {begin + 1} .. {end}")
        if begin == 0:
            return part
        outputs = part.outputs.copy()
        outputs[1 : int(_RUN_IN * len(outputs))] = np.nan
        return replace(part, outputs=outputs)

    def of_all(self, objective: Objective) -> Objective:
        """An objective of the records as that of the parts."""
        part = objective.on(self.datasets(), self.places)
        return part.over(objective.space.without_starts().with_starts(part.records))

    def on_parts(
        self, space: SearchSpace, part_space: SearchSpace, chromosome: FloatArray
    ) -> FloatArray:
        """A chromosome (n_free,) of the records as that of the parts.

        The part at a record's beginning starts where the record does, others as declared.
        """
        n = len(space.index)
        on_parts = part_space.with_nominal_starts(chromosome[:n])
        starts = dict(zip(space.estimated, chromosome[n:], strict=True))
        for j, (k, state) in enumerate(part_space.estimated):
            if self.parts[k].begin == 0:
                on_parts[n + j] = starts[self.parts[k].place, state]
        low, high = np.array([(p.lower, p.upper) for p in part_space.parameters]).T
        return np.clip(on_parts, low, high)

    def on_all(
        self, space: SearchSpace, chromosomes: Sequence[FloatArray]
    ) -> tuple[SearchSpace, list[FloatArray]]:
        """Space and chromosomes (n_free,) of the parts as those of the records.

        A record starts where the part at its beginning does.
        """
        n, head = len(space.index), {part.place: k for k, part in enumerate(self.parts)}
        head |= {part.place: k for k, part in enumerate(self.parts) if part.begin == 0}
        plain = space.without_starts()
        if not space.estimated:
            return plain, [chromosome[:n] for chromosome in chromosomes]
        whole = plain.with_starts(self.records)
        column = {start: n + j for j, start in enumerate(space.estimated)}
        columns = [*range(n), *(column[head[place], state] for place, state in whole.estimated)]
        # A range around the first sample may be narrower for the part than for all.
        ends = [(p.lower, p.upper) for p in whole.parameters]
        low, high = np.array(ends).T
        low[:n], high[:n] = -np.inf, np.inf
        return whole, [np.clip(chromosome[columns], low, high) for chromosome in chromosomes]


def _telling(record: Dataset, count: int) -> list[int]:
    """First rows of the parts that tell most beside the one at the beginning, sorted."""
    moments = _moments(record)
    begins = np.arange(len(moments)) * (_LENGTH // 2)
    free = begins >= _LENGTH
    chosen = [0]
    sum_of_moments = moments[0] + _RIDGE * _LENGTH * np.eye(moments.shape[1])
    while len(chosen) < count and free.any():
        gains = np.linalg.slogdet(sum_of_moments + moments)[1]
        best = int(np.argmax(np.where(free, gains, -np.inf)))
        chosen.append(best)
        sum_of_moments += moments[best]
        free &= np.abs(begins - begins[best]) >= _LENGTH
    return sorted(begins[chosen].tolist())


def _moments(record: Dataset) -> FloatArray:
    """Sums of products of channels, their changes and one, (n_parts, n, n), half a part apart."""
    channels = np.concatenate([record.inputs, record.outputs], axis=1)
    seen = np.isfinite(channels)
    mean = np.where(seen, channels, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    channels = np.where(seen, channels - mean, 0.0)
    changes = np.diff(channels, axis=0, prepend=channels[:1])
    signals = np.concatenate([channels, changes], axis=1)
    size = signals.std(axis=0)
    signals /= np.where(size > 0.0, size, 1.0)
    signals = np.concatenate([signals, np.ones((len(signals), 1))], axis=1)
    halves = len(signals) // (_LENGTH // 2)
    pieces = signals[: halves * (_LENGTH // 2)].reshape(halves, _LENGTH // 2, -1)
    half_moments = np.einsum("kti,ktj->kij", pieces, pieces)
    moments: FloatArray = half_moments[:-1] + half_moments[1:]
    return moments
