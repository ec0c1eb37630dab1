"""Relation between the host's clock and the device's: offset and drift, from round trips."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_WINDOW = 1.0  # s of which the quickest round trip is kept
_KEPT = 1024  # windows; beyond, neighbours are joined


@dataclass(frozen=True)
class Relation:
    """device time = offset + (1 + drift) * (host time - reference), all in seconds.

    uncertainty: half the quickest round trip, which bounds the error of the offset [s].
    drift_error: standard error of the drift; infinite from less than three windows.
    """

    reference: float
    offset: float
    drift: float
    uncertainty: float
    drift_error: float
    round_trips: int

    def device_time(self, host: float) -> float:
        """The device's clock at a time of the host's [s]."""
        return self.offset + (1.0 + self.drift) * (host - self.reference)

    def describe(self) -> dict[str, Any]:
        """For run.json."""
        known = math.isfinite(self.drift_error)
        return {
            "reference_host_seconds": self.reference,
            "offset_seconds": self.offset,
            "offset_uncertainty_seconds": self.uncertainty,
            "drift_ppm": 1e6 * self.drift if known else None,
            "drift_error_ppm": 1e6 * self.drift_error if known else None,
            "round_trips": self.round_trips,
        }


@dataclass
class ClockEstimator:
    """Gathers round trips and fits the relation; its memory is bounded.

    A message is delayed by a scheduler or an adapter, never hurried: in every window the
    quickest round trip has the least of it, and only that is kept (as NTP's clock filter does;
    Mills, RFC 5905, section 10).
    """

    round_trips: int = 0
    _window: float = _WINDOW
    _opened: float = 0.0
    _best: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, sent: float, device: float, received: float) -> None:
        """One round trip: host times of sending and receiving, device time between them [s]."""
        trip = (received - sent, 0.5 * (sent + received), device)
        self.round_trips += 1
        if self._best and trip[1] - self._opened < self._window:
            self._best[-1] = min(self._best[-1], trip)
            return
        self._opened = trip[1]
        self._best.append(trip)
        if len(self._best) > _KEPT:
            pairs = zip(self._best[::2], [*self._best[1::2], self._best[-1]], strict=False)
            self._best = [min(pair) for pair in pairs]
            self._window *= 2.0

    @property
    def quickest(self) -> float:
        """The shortest round trip [s]; infinite before the first."""
        return min((trip[0] for trip in self._best), default=math.inf)

    def relation(self) -> Relation | None:
        """The best relation so far; None before the first round trip."""
        if not self._best:
            return None
        trips, host, device = np.array(self._best).T
        reference = float(host[0])
        x, y = host - reference, (device - device[0]) - (host - reference)
        # A trip's error is at most half of what it took longer than the line needs.
        spread = 0.5 * (trips - trips.min()) + 0.05 * trips.min() + 1e-6
        weight = spread**-2.0
        centre = float(weight @ x / weight.sum())
        mean = float(weight @ y / weight.sum())
        moment = float(weight @ (x - centre) ** 2)
        drift, error = 0.0, math.inf
        if len(x) > 2 and moment > 0.0:
            drift = float(weight @ ((x - centre) * (y - mean)) / moment)
            left = y - mean - drift * (x - centre)
            error = math.sqrt(float(weight @ left**2) / (len(x) - 2) / moment)
        offset = float(device[0]) + mean - drift * centre
        return Relation(reference, offset, drift, 0.5 * float(trips.min()), error, self.round_trips)
