"""The state of a descent between two iterations, and its strategies where it stalls.

A strategy returns a stalled descent as it goes on, or None where it gives up. Those for a kind of
stall are tried in turn; a descent that they all give up has finished.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.objective import FLOORS, Objective
from sysid.fitting.quadratic import FIRST_DAMPING, heavier
from sysid.problem.space import SearchSpace

# Sizes of the perturbations, in parts of the ranges. The first is for what is smooth: where
# parameters are nearly tied their slopes all but cancel along the valley, so that neither their
# change within the perturbation nor rounding may count. Where something switches (dry friction, an
# overflow) the instant of switching moves in steps of the integration, and only a larger
# perturbation shows what it depends on.
PERTURBATIONS = (1e-8, 1e-5, 1e-4, 1e-3, 1e-2)
TOLERANCE = 1e-7  # share of the error that ends a descent where nothing else is said
PATIENCE = 3  # failures in a row, the later ones with more damping
NOTHING = 1e-3  # share of the error that is not worth a change of perturbations
_STEADIER, _BRACINGS = 1.5, 3
# Parts of the ranges within which integration steps, and corrections, need not be chosen anew.
_NEAR = 1e-3
_CRAWLS = 5  # iterations that gain little, from which on it stays so


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
class Restriction:
    """What a descent keeps to beside the ranges.

    held: a search coordinate, and the value that it keeps. tether: of chromosomes (n, n_free) one
    residual more, (n,), which pulls a quantity to a target.
    """

    held: tuple[int, float] | None = None
    tether: Callable[[FloatArray], FloatArray] | None = None

    def bounds(self, space: SearchSpace) -> tuple[FloatArray, FloatArray]:
        """Ends of the search coordinates, (n_free,) each."""
        if self.held is None:
            return space.coded_bounds
        place, value = self.held
        lower, upper = (bounds.copy() for bounds in space.coded_bounds)
        lower[place] = upper[place] = value
        return lower, upper


FREE = Restriction()


@dataclass(frozen=True)
class Shift:
    """What residuals by the objective's simulations are more than by those of a descent.

    at: (n_free,), where. steps: of those simulations, per sample, for each record; coarse: the
    descent's. values: (n_residuals, n_outputs).
    """

    at: FloatArray
    steps: tuple[int, ...]
    coarse: tuple[int, ...]
    values: FloatArray


@dataclass(frozen=True)
class Descent:
    """A descent at a point; ``refinement.advance`` returns it one iteration further.

    tolerance: share of the error; one that is promised or gains no more has arrived. safe:
    where integration steps were last chosen and a simulation with them succeeded; beyond, the
    steps may not do. steps: per sample, for each record; steps_at: the coordinates they were
    chosen at, None where they are yet to be; braced: how often they have been raised since for
    the neighbours' sake. gain: share of the error that the last iteration took away. failures:
    iterations in a row that gained nothing, or hardly any of what was promised. level: of
    ``PERTURBATIONS``. error_of_round: the error where the present round of levels began.
    smoothing: which of ``FLOORS``. backward: coordinates whose neighbours are taken on the
    other side, because simulations fail on the usual one. cautious: whether lambda shortens all
    steps, since one has led to where simulations fail. shift: of a descent by coarse simulations,
    which their residuals are corrected by. crawling: iterations in a row that gained little of what
    was promised; goal: an error above which a descent that crawls is given up.
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
    backward: tuple[int, ...] = ()
    cautious: bool = False
    tolerance: float = TOLERANCE
    restriction: Restriction = FREE
    shift: Shift | None = None
    crawling: int = 0
    goal: float = np.inf

    @property
    def is_given_up(self) -> bool:
        """Whether it crawls, far from where its end would be of interest."""
        return self.crawling >= _CRAWLS and self.point.error > self.goal

    @property
    def is_corrected(self) -> bool:
        """Whether its shift was taken where its steps were chosen, and is that of these steps."""
        shift, at = self.shift, self.steps_at
        if shift is None or at is None:
            return False
        return shift.coarse == self.steps and np.array_equal(shift.at, at)

    @property
    def floor(self) -> float:
        """The floor below which outputs' errors are smoothed."""
        return FLOORS[self.smoothing] * self.point.error

    def state(self) -> dict[str, Any]:
        """The state in plain values and arrays, of one that nothing restricts."""
        at, error = (None, np.inf) if self.safe is None else (self.safe.at, self.safe.error)
        state = vars(self) | vars(self.point) | {"sure": at, "sure_error": error}
        for name in ("point", "safe", "restriction", "shift", "crawling", "goal"):
            del state[name]
        return state

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Self:
        """The descent of a ``state``."""
        rest = dict(state)
        at, error = rest.pop("sure"), rest.pop("sure_error")
        point = Point(*(rest.pop(field.name) for field in fields(Point)))
        return cls(point, safe=None if at is None else Point(at, error), **rest)


def retreat(_: Objective, descent: Descent) -> Descent | None:
    """Back to the safe point, to try more damping, until patience ends."""
    if descent.safe is None:
        return None
    failures = descent.failures + 1
    return replace(
        descent,
        point=descent.safe,
        steps_at=None,
        damping=heavier(descent.damping),
        gain=0.0,
        failures=failures,
        iterations=descent.iterations + 1,
        finished=failures >= PATIENCE,
        cautious=True,
    )


def brace(_: Objective, descent: Descent) -> Descent | None:
    """Half as many integration steps more, which at the edge of stability the neighbours need.

    Gives up after three times: then it is the model that is unbounded there.
    """
    if descent.braced == _BRACINGS:
        return None
    more = tuple(math.ceil(_STEADIER * steps) for steps in descent.steps)
    return replace(descent, steps=more, braced=descent.braced + 1)


def coarsen(_: Objective, descent: Descent) -> Descent | None:
    """The next larger perturbations.

    More damping has not helped, so it is the slopes that are wrong: to small perturbations
    equations that switch, as dry friction, are steps and plateaus.
    """
    if descent.level + 1 == len(PERTURBATIONS):
        return None
    return replace(descent, level=descent.level + 1, failures=0, damping=FIRST_DAMPING)


def sharpen(objective: Objective, descent: Descent) -> Descent | None:
    """The next lower floor, where an output's error is below the present one.

    Descents stop on the crease that the error has where an output is explained exactly, so they
    approach it smoothed.
    """
    if objective.smooth:
        return None
    rms = descent.point.rms
    assert rms is not None
    below = np.any(rms[objective.weights > 0.0] < descent.floor)
    if not below or descent.smoothing + 1 == len(FLOORS):
        return None
    return replace(descent, smoothing=descent.smoothing + 1, failures=0)


def resolve(objective: Objective, descent: Descent) -> Descent | None:
    """More integration steps, where the point needs more than were chosen some way back."""
    at, steps_at, space = descent.point.at, descent.steps_at, objective.space
    if steps_at is not None and np.all(np.abs(at - steps_at) <= _NEAR * space.width):
        return None
    needed = objective.steps_needed(space.decode(at[None]))[0].tolist()
    steps = tuple(max(pair) for pair in zip(needed, descent.steps, strict=True))
    if steps == descent.steps:
        return None
    return replace(descent, steps=steps, steps_at=at, failures=0)


def correct(objective: Objective, descent: Descent) -> Descent | None:
    """The coarse simulations corrected anew, where they were some way back."""
    at, shift = descent.point.at, descent.shift
    if shift is None or np.all(np.abs(at - shift.at) <= _NEAR * objective.space.width):
        return None
    return replace(descent, steps_at=at, failures=0)


def refocus(_: Objective, descent: Descent) -> Descent | None:
    """The smallest perturbations once more, where larger ones have gained something."""
    at, error = descent.point.at, descent.point.error
    if descent.level == 0 or error > (1.0 - NOTHING) * descent.error_of_round:
        return None
    return replace(descent, steps_at=at, level=0, failures=0, error_of_round=error)


_ARRIVED = (sharpen, resolve, correct, refocus)
STRATEGIES: dict[str, tuple[Callable[[Objective, Descent], Descent | None], ...]] = {
    "failed": (retreat,),  # the simulation of the point fails
    "burst": (brace,),  # those of neighbours leave that of the point by far
    "arrived": _ARRIVED,  # hardly anything was promised, or gained
    "misled": (coarsen, *_ARRIVED),  # gains stay far behind promises, whatever the damping
}


def resumed(objective: Objective, descent: Descent, stall: str) -> Descent:
    """The descent as the first strategy that does not give up lets it go on, or else finished."""
    for strategy in STRATEGIES[stall]:
        onward = strategy(objective, descent)
        if onward is not None:
            return onward
    return replace(descent, finished=True)
