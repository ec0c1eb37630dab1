"""Parts of long records by which a search goes, before all of them are fitted.

A search takes thousands of simulations, and where minima lie a few thousand samples tell as well as
a long record, or as many records. The records, and the parts of each, are those whose channels and
their changes vary most between them: the determinant of the sum of their moments is made large, one
after the other (greedy D-optimality, as in Fedorov, "Theory of optimal experiments", 1972, with the
moments in place of a model's information). Those of staircases are the ramps and steps, at every
level.
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
# Of records that repeat each other a quarter tells enough, of no fewer and no more samples.
_PART, _REPEATED = 0.25, (2048, 4096)
# Ratio of the mean squares of any combination of signals, of a record and those chosen, up to which
# it repeats them.
_ALIKE = 4.0
_RIDGE = 1e-3  # moments of channels that do not move, in parts of one that does


class Part(NamedTuple):
    """Rows from ``begin`` up to ``end`` of the record at a place."""

    place: int
    begin: int
    end: int


@dataclass(frozen=True)
class Excerpt:
    """Parts of some records, those of each in order of time and the first from its first row.

    cut: whether a fit goes by nothing else, so that parts are records ``cut`` from others.
    """

    records: Sequence[Dataset]
    parts: tuple[Part, ...]
    cut: bool = False

    @classmethod
    def of(cls, records: Sequence[Dataset], samples: int, *, every: bool = True) -> Excerpt | None:
        """An excerpt of about that many samples; None where it would be more than half of all.

        Of a record as many parts as its share, one at least; a record shorter than two parts whole.
        Of every record, or of as many as it takes: a parameter may be told by one record alone. Of
        short records that repeat each other a few in any case.
        """
        total = sum(record.n_samples for record in records)
        if samples == 0:
            return None
        part = int(np.clip(_PART * total, *_REPEATED))
        chosen: Sequence[int] = _repeated(records, min(samples, part))
        if not chosen:
            if total <= 2 * samples:
                return None
            chosen = range(len(records)) if every else _telling_records(records, samples)
        share = samples / _LENGTH / sum(records[place].n_samples for place in chosen)
        parts: list[Part] = []
        for place in chosen:
            record = records[place]
            whole = _least(record) == record.n_samples
            begins = [0] if whole else _telling(record, max(1, round(share * record.n_samples)))
            parts += [Part(place, begin, begin + _least(record)) for begin in begins]
        excerpt = cls(tuple(records), tuple(parts))
        return excerpt if 2 * excerpt.n_samples <= total else None

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
        part = replace(part, log=place if self.cut else None)
        if begin == 0:
            return part
        outputs = part.outputs.copy()
        outputs[1 : int(_RUN_IN * len(outputs))] = np.nan
        return replace(part, outputs=outputs, cut=self.cut)

    def among(self, objective: Objective) -> Objective:
        """An objective of the records as that of the parts, over the same space."""
        return objective.on(self.datasets(), self.places)

    def of_all(self, objective: Objective) -> Objective:
        """An objective of the records as that of the parts."""
        part = self.among(objective)
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

    def places_on_all(self, space: SearchSpace) -> list[int]:
        """Which coordinates of the parts (n_free,) those of the records are, in order."""
        n = len(space.index)
        heads = [j for j, (k, _) in enumerate(space.estimated) if self.parts[k].begin == 0]
        return [*range(n), *(n + j for j in heads)]

    def on_all(
        self, space: SearchSpace, chromosomes: Sequence[FloatArray]
    ) -> tuple[SearchSpace, list[FloatArray]]:
        """Space and chromosomes (n_free,) of the parts as those of the records.

        A record starts where the part at its beginning does, one without parts as declared.
        """
        n = len(space.index)
        head = {part.place: k for k, part in enumerate(self.parts) if part.begin == 0}
        plain = space.without_starts()
        whole = plain.with_starts(self.records)
        bare = not space.estimated and plain.with_starts(self.datasets()).estimated
        if bare or not whole.estimated:
            return plain, [chromosome[:n] for chromosome in chromosomes]
        column = {start: n + j for j, start in enumerate(space.estimated)}
        columns = {
            n + j: column[head[place], state]
            for j, (place, state) in enumerate(whole.estimated)
            if place in head
        }
        # A range around the first sample may be narrower for the part than for all.
        ends = [(p.lower, p.upper) for p in whole.parameters]
        low, high = np.array(ends).T
        low[:n], high[:n] = -np.inf, np.inf
        on_all = whole.with_nominal_starts(np.stack(chromosomes)[:, :n])
        on_all[:, list(columns)] = np.stack(chromosomes)[:, list(columns.values())]
        return whole, list(np.clip(on_all, low, high))


def _least(record: Dataset) -> int:
    """Samples of the least that is taken of a record: all of a short one."""
    return record.n_samples if record.n_samples < 2 * _LENGTH else _LENGTH


def _repeated(records: Sequence[Dataset], samples: int) -> list[int]:
    """As ``_telling_records`` of short records that all are alike; none where one is not."""
    if len(records) == 1 or any(record.n_samples > _least(record) for record in records):
        return []
    chosen, moments = _telling_records(records, samples), _mean_moments(records)
    moments += _RIDGE * np.eye(moments.shape[1])
    back = np.linalg.inv(np.linalg.cholesky(moments[chosen].mean(axis=0)))
    ratios = np.linalg.eigvalsh(back @ moments @ back.T)
    return chosen if ratios.max() < _ALIKE and ratios.min() > 1.0 / _ALIKE else []


def _mean_moments(records: Sequence[Dataset]) -> FloatArray:
    """Means of products of the signals of each, (n_records, n, n)."""
    return np.array([signals.T @ signals / len(signals) for signals in _signals(records)])


def _telling_records(records: Sequence[Dataset], samples: int) -> list[int]:
    """Places of the records that tell most together, sorted, of at least so many samples.

    With every output that is measured at all.
    """
    moments = _mean_moments(records)
    seen = np.array([np.isfinite(record.outputs).any(axis=0) for record in records])
    sizes = np.array([_least(record) for record in records])
    chosen = np.zeros(len(records), dtype=bool)
    sum_of_moments = _RIDGE * np.eye(moments.shape[1])
    while True:
        lacking = ~seen[chosen].any(axis=0)
        enough = sizes[chosen].sum() > samples - _LENGTH // 2
        free = ~chosen & (seen[:, lacking].any(axis=1) if enough else True)
        if not free.any():
            return np.flatnonzero(chosen).tolist()
        gains = np.linalg.slogdet(sum_of_moments + moments)[1]
        best = int(np.argmax(np.where(free, gains, -np.inf)))
        chosen[best] = True
        sum_of_moments = sum_of_moments + moments[best]


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
    """Sums of products of the signals, (n_parts, n, n), half a part apart."""
    (signals,) = _signals([record])
    halves = len(signals) // (_LENGTH // 2)
    pieces = signals[: halves * (_LENGTH // 2)].reshape(halves, _LENGTH // 2, -1)
    half_moments = np.einsum("kti,ktj->kij", pieces, pieces)
    moments: FloatArray = half_moments[:-1] + half_moments[1:]
    return moments


def _signals(records: Sequence[Dataset]) -> list[FloatArray]:
    """Channels, their changes and one, (n_samples, n), in parts of how all records vary."""
    channels = [np.concatenate([record.inputs, record.outputs], axis=1) for record in records]
    seen = np.isfinite(np.concatenate(channels))
    total = np.where(seen, np.concatenate(channels), 0.0).sum(axis=0)
    mean = total / np.maximum(seen.sum(axis=0), 1)
    centred = [np.where(np.isfinite(part), part - mean, 0.0) for part in channels]
    signals = [np.hstack([part, np.diff(part, axis=0, prepend=part[:1])]) for part in centred]
    size = np.concatenate(signals).std(axis=0)
    size[size == 0.0] = 1.0
    return [np.hstack([part / size, np.ones((len(part), 1))]) for part in signals]
