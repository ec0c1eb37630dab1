"""Relation between the host's clock and the device's: offset, drift, bounds of its rate."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_WINDOW = 1.0  # s of which the quickest round trip is kept
_KEPT = 1024  # windows; beyond, neighbours are joined

RATE_TOLERANCE = 0.01  # share of a rate beyond which it is another than the one agreed on


@dataclass
class RateBounds:
    """Bounds of a clock's rate by the host's that no delay of a message can make wrong.

    A reading was taken at some instant between sending and receiving. Two of them bound the rate
    from both sides, the more closely the longer they lie apart.
    """

    lowest: float = 0.0
    highest: float = math.inf
    _anchor: tuple[float, float, float] | None = None

    def add(self, sent: float, reading: float, received: float) -> None:
        """Add a round trip: host times of sending and receiving, the clock between them [s]."""
        if self._anchor is None:
            self._anchor = sent, reading, received
            return
        earliest, before, latest = self._anchor
        passed = reading - before
        if received > earliest:
            self.lowest = max(self.lowest, passed / (received - earliest))
        if sent > latest:
            self.highest = min(self.highest, passed / (sent - latest))
        if received - sent < 0.5 * (latest - earliest):
            self._anchor = sent, reading, received

    def deviation(self) -> float | None:
        """By which share the rate is wrong at the least; None for one that may be right."""
        if self.lowest > 1.0 + RATE_TOLERANCE:
            return self.lowest - 1.0
        if self.highest < 1.0 - RATE_TOLERANCE:
            return self.highest - 1.0
        return None


@dataclass
class ClockEstimator:
    """Gathers round trips and fits the relation; its memory is bounded.

    A message is delayed by a scheduler or an adapter, never hurried: in each window the
    quickest round trip has the least of it, and only that is kept (as NTP's clock filter does;
    Mills, RFC 5905, section 10).
    """

    round_trips: int = 0
    _window: float = _WINDOW
    _opened: float = 0.0
    _quickest: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, sent: float, device: float, received: float) -> None:
        """Add a round trip: host times of sending and receiving, device time between them [s]."""
        trip = (received - sent, 0.5 * (sent + received), device)
        self.round_trips += 1
        if self._quickest and trip[1] - self._opened < self._window:
            self._quickest[-1] = min(self._quickest[-1], trip)
            return
        self._opened = trip[1]
        self._quickest.append(trip)
        if len(self._quickest) > _KEPT:
            trips = self._quickest
            pairs = zip(trips[::2], [*trips[1::2], trips[-1]], strict=False)
            self._quickest = [min(pair) for pair in pairs]
            self._window *= 2.0

    @property
    def quickest(self) -> float:
        """The shortest round trip [s]; infinite before the first."""
        return min((trip[0] for trip in self._quickest), default=math.inf)

    def describe(self) -> dict[str, Any] | None:
        """The relation for run.json; None before the first round trip.

        device time = offset + (1 + drift) * (host time - reference). The offset is uncertain by
        half the quickest round trip, which its change from end to end adds to the drift's error;
        the drift needs three windows.
        """
        if not self._quickest:
            return None
        trips, host, device = np.array(self._quickest).T
        x, y = host - host[0], (device - device[0]) - (host - host[0])
        # A trip's error is at most half of what it took longer than the line needs.
        spread = 0.5 * (trips - trips.min()) + 0.05 * trips.min() + 1e-6
        weight = spread**-2.0
        centre, mean = float(weight @ x / weight.sum()), float(weight @ y / weight.sum())
        moment = float(weight @ (x - centre) ** 2)
        drift, drift_error = 0.0, None
        if len(x) > 2 and moment > 0.0:
            drift = float(weight @ ((x - centre) * (y - mean)) / moment)
            residuals = y - mean - drift * (x - centre)
            scatter = math.sqrt(float(weight @ residuals**2) / (len(x) - 2) / moment)
            drift_error = math.hypot(scatter, 0.5 * float(trips.min()) / float(x[-1]))
        return {
            "reference_host_seconds": float(host[0]),
            "offset_seconds": float(device[0]) + mean - drift * centre,
            "offset_uncertainty_seconds": 0.5 * float(trips.min()),
            "drift_ppm": None if drift_error is None else 1e6 * drift,
            "drift_error_ppm": None if drift_error is None else 1e6 * drift_error,
            "round_trips": self.round_trips,
        }
