"""The state of a descent between two iterations."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

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
class Descent:
    """A descent at a point; ``refinement.advance`` returns it one iteration further.

    safe: where integration steps were last chosen and a simulation with them succeeded; beyond,
    the steps may not do. steps: per sample, for each record; steps_at: the coordinates they were
    chosen at, None where they are yet to be; braced: how often they have been raised since for
    the neighbours' sake. gain: share of the error that the last iteration took away. failures:
    iterations in a row that gained nothing, or hardly any of what was promised. level: of
    ``PERTURBATIONS``. error_of_round: the error where the present round of levels began.
    smoothing: which of ``FLOORS``.
    """

    point: Point
    safe: Point | None = None
    steps: tuple[int, ...] = ()
    steps_at: FloatArray | None = None
    braced: int = 0
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
        at, error = (None, np.inf) if self.safe is None else (self.safe.at, self.safe.error)
        state = vars(self) | vars(self.point) | {"sure": at, "sure_error": error}
        del state["point"], state["safe"]
        return state

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Self:
        """The descent of a ``state``."""
        rest = dict(state)
        at, error = rest.pop("sure"), rest.pop("sure_error")
        point = Point(*(rest.pop(field.name) for field in fields(Point)))
        return cls(point, None if at is None else Point(at, error), **rest)
