"""The state of a descent between two iterations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.quadratic import FIRST_DAMPING

# Sizes of the perturbations, in parts of the ranges. The first is for what is smooth. Where
# something switches (dry friction, an overflow) the instant of switching moves in steps of the
# integration, and only a larger perturbation shows what it depends on.
PERTURBATIONS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
# Floors below which outputs' errors are smoothed, in parts of the error.
FLOORS = (1e-1, 1e-2, 1e-3)


@dataclass(frozen=True)
class Point:
    """Search coordinates (n_free,) and the error there.

    rms: (n_outputs,), the outputs' errors, None before they have been simulated. excess: that
    simulation's error estimate in parts of what the accuracy allows.
    """

    at: FloatArray
    error: float = np.inf
    rms: FloatArray | None = None
    excess: float = np.inf

    @property
    def accurate_rms(self) -> FloatArray | None:
        """The outputs' errors if their simulation had the integration steps that it needs."""
        return self.rms if self.excess <= 1.0 else None


@dataclass(frozen=True)
class Integration:
    """Integration steps per sample for each record, and the coordinates they were chosen at.

    steps_at: None where they are yet to be chosen. braced: how often they have been raised since
    for the neighbours' sake.
    """

    steps: tuple[int, ...] = ()
    steps_at: FloatArray | None = None
    braced: int = 0


@dataclass(frozen=True)
class Descent:
    """A descent at a point; ``refinement.advance`` returns it one iteration further.

    safe: coordinates at which integration steps were last chosen and a simulation with them
    succeeded, and the error there; beyond, the steps may not do. gain: share of the error that
    the last iteration took away. failures: iterations in a row that gained nothing, or hardly any
    of what was promised. level: of ``PERTURBATIONS``. error_of_round: the error where the present
    round of levels began. smoothing: which of ``FLOORS``.
    """

    point: Point
    safe: Point | None = None
    integration: Integration = Integration()
    damping: float = FIRST_DAMPING
    gain: float = 0.0
    failures: int = 0
    level: int = 0
    error_of_round: float = np.inf
    smoothing: int = 0
    iterations: int = 0
    finished: bool = False

    @property
    def floor(self) -> float:
        """The floor below which outputs' errors are smoothed."""
        return FLOORS[self.smoothing] * self.point.error

    def state(self) -> dict[str, Any]:
        """The state in plain values and arrays."""
        state = vars(self) | vars(self.point) | vars(self.integration)
        for part in ("point", "integration", "safe"):
            del state[part]
        safe = (None, np.inf) if self.safe is None else (self.safe.at, self.safe.error)
        return state | dict(zip(("sure", "sure_error"), safe, strict=True))

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Descent:
        """The descent of a ``state``."""
        rest = dict(state)
        at, error = rest.pop("sure"), rest.pop("sure_error")
        safe = None if at is None else Point(at, error)
        point = Point(**{field.name: rest.pop(field.name) for field in fields(Point)})
        integration = Integration(
            **{field.name: rest.pop(field.name) for field in fields(Integration)}
        )
        return cls(point, safe, integration, **rest)
