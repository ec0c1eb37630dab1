"""How punctual a run was: time between blocks, from a sample to its answer, late and lost ones."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from daq.hal import Flag, Samples

_PARTS = 4  # bins in which each doubling of time is counted
_SHIFT = 2  # bits of _PARTS
_NAMED = 20  # ticks that the record names
_NANO = 1e-9


class Histogram:
    """Durations counted in bins that grow with them, each a quarter of a doubling wide.

    Twenty per cent of resolution at any length, and a tenth of a microsecond to count one.
    """

    def __init__(self) -> None:
        self._counts = [0] * (64 * _PARTS)
        self._total = 0
        self._worst = 0
        self._worst_tick = 0

    def add(self, nanoseconds: int, tick: int) -> None:
        """Count a duration that ended with a tick."""
        length = nanoseconds.bit_length()
        part = (nanoseconds >> (length - 1 - _SHIFT)) & (_PARTS - 1) if length > _SHIFT else 0
        self._counts[length * _PARTS + part] += 1
        self._total += nanoseconds
        if nanoseconds > self._worst:
            self._worst, self._worst_tick = nanoseconds, tick

    @property
    def count(self) -> int:
        """How many were counted."""
        return sum(self._counts)

    def quantile(self, share: float) -> float:
        """Upper end of the bin that a share of all durations does not exceed [s]."""
        wanted, seen = share * self.count, 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(_upper(index), self._worst * _NANO)
        return 0.0

    def summary(self) -> dict[str, Any]:
        """For run.json: mean, quantiles, the worst and where, and the bins that hold any."""
        filled = [index for index, count in enumerate(self._counts) if count]
        return {
            "count": self.count,
            "mean_seconds": self._total * _NANO / max(self.count, 1),
            "median_seconds": self.quantile(0.5),
            "p99_seconds": self.quantile(0.99),
            "worst_seconds": self._worst * _NANO,
            "worst_tick": self._worst_tick,
            "histogram": {
                "up_to_seconds": [_upper(index) for index in filled],
                "counts": [self._counts[index] for index in filled],
            },
        }


def _upper(index: int) -> float:
    length, part = divmod(index, _PARTS)
    if length <= _SHIFT:
        return float((1 << length) * _NANO)
    return (1 << (length - 1 - _SHIFT)) * (_PARTS + part + 1) * _NANO


@dataclass
class Timing:
    """What the run phase measures of itself."""

    arrivals: Histogram = field(default_factory=Histogram)
    answers: Histogram = field(default_factory=Histogram)
    flags: dict[str, int] = field(default_factory=dict)
    held: list[int] = field(default_factory=list)
    lost_after: list[int] = field(default_factory=list)
    lost: int = 0
    _started: float = field(default_factory=time.perf_counter)
    _received: int = field(default_factory=time.perf_counter_ns)
    _tick: int = -1

    def received(self, samples: Samples) -> None:
        """A block has arrived, just now."""
        now = time.perf_counter_ns()
        first, last = samples.tick.item(0), samples.tick.item(-1)
        self.arrivals.add(now - self._received, first)
        self._received = now
        if last - self._tick != len(samples):
            self._note_gaps(samples)
        self._tick = last

    def answered(self, tick: int) -> None:
        """The command that answers the last sample received, of this tick, has been sent."""
        self.answers.add(time.perf_counter_ns() - self._received, tick)

    def logged(self, samples: Samples) -> None:
        """These are kept: count their flags."""
        if not samples.flags.any():
            return
        for flag in Flag:
            marked = (samples.flags & int(flag)) != 0
            count = int(np.count_nonzero(marked))
            if not count:
                continue
            name = str(flag.name).lower()
            self.flags[name] = self.flags.get(name, 0) + count
            if flag is Flag.HELD:
                self.held += samples.tick[marked].tolist()[: _NAMED - len(self.held)]

    def _note_gaps(self, samples: Samples) -> None:
        before = np.concatenate([[self._tick], samples.tick])
        steps = np.diff(before)
        self.lost += int((steps - 1).sum())
        after = before[:-1][steps != 1].tolist()
        self.lost_after += after[: _NAMED - len(self.lost_after)]

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        return {
            "wall_seconds": round(time.perf_counter() - self._started, 6),
            "blocks": self.arrivals.count,
            "flagged_samples": self.flags,
            "arrival": self.arrivals.summary(),
            "answer": self.answers.summary() if self.answers.count else None,
            "late": {"commands": self.flags.get("held", 0), "first_ticks": self.held},
            "lost": {"samples": self.lost, "after_ticks": self.lost_after},
        }
