"""Strategies of a descent that stalls.

A strategy returns a stalled descent as it goes on, or None where it gives up. Those for a kind of
stall, at the end, are tried in turn; a descent that they all give up has finished.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.fitting.descent import FLOORS, PERTURBATIONS, Descent
from sysid.fitting.objective import Objective
from sysid.fitting.quadratic import FIRST_DAMPING, heavier

PATIENCE = 3  # failures in a row, the later ones with more damping
NOTHING = 1e-3  # share of the error that is not worth a change of perturbations
_STEADIER, _BRACINGS = 1.5, 3
_NEAR = 1e-3  # parts of the ranges within which integration steps need not be chosen anew

Strategies = tuple[Callable[[Objective, Descent], Descent | None], ...]


def retreat(_: Objective, descent: Descent) -> Descent | None:
    """Back to the safe point, to try more damping, until patience ends.

    Integration steps chosen anew have shown that the simulation of the point fails.
    """
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


def refocus(_: Objective, descent: Descent) -> Descent | None:
    """The smallest perturbations once more, where larger ones have gained something."""
    at, error = descent.point.at, descent.point.error
    if descent.level == 0 or error > (1.0 - NOTHING) * descent.error_of_round:
        return None
    return replace(descent, steps_at=at, level=0, failures=0, error_of_round=error)


FAILED: Strategies = (retreat,)  # the simulation of the point fails
BURST: Strategies = (brace,)  # those of neighbours leave that of the point by far
ARRIVED: Strategies = (sharpen, resolve, refocus)  # hardly anything was promised, or gained
MISLED: Strategies = (coarsen, *ARRIVED)  # gains stay far behind promises, whatever the damping


def resumed(objective: Objective, descent: Descent, strategies: Strategies) -> Descent:
    """The descent as the first strategy that does not give up lets it go on, or else finished."""
    for strategy in strategies:
        onward = strategy(objective, descent)
        if onward is not None:
            return onward
    return replace(descent, finished=True)
