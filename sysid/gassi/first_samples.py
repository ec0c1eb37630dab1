"""States that start at a measured first sample, whose noise a run keeps as long as it remembers it.

Of a position that is a long time: the noise of one sample then counts for more than that of all
others together, and the start is better estimated than read.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.moves import directions
from sysid.fitting.objective import Objective
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel
from sysid.problem.space import SearchSpace
from sysid.uncertainty.sensitivity import sensitivity, start_errors

_NOTICEABLE = 1.0  # deviations of any quantity that the noise of first samples may move it by


def noticed_starts(
    objective: Objective, chromosome: FloatArray, kept: Collection[str]
) -> tuple[str, ...]:
    """States whose first samples' noise moves a quantity noticeably, at a minimum (n_free,).

    kept: names of states that start there all the same.
    """
    local, names = sensitivity(objective, chromosome), objective.simulator.model.state_names
    # An output that is explained too well to decide counts as if by more noise than it has.
    rms = np.sqrt(np.mean(local.residual**2, axis=0))
    counting = np.sqrt(objective.least_squares_weights(local.residual)) * (rms > 0.0)
    noise = np.full_like(rms, np.inf)
    np.divide((rms * counting).max(), counting, out=noise, where=counting > 0.0)
    made_up_for = directions(local.slopes / noise[:, None])
    squares = np.zeros(len(names))
    for state, change in start_errors(local):
        squares[state] += np.sum((made_up_for.T @ (change / noise).ravel()) ** 2)
    noticed = (names[i] for i in np.flatnonzero(squares > _NOTICEABLE**2))
    return tuple(name for name in noticed if name not in kept)


def with_starts(
    model: ProcessModel, records: Sequence[Dataset], before: SearchSpace, chromosome: FloatArray
) -> tuple[SearchSpace, FloatArray]:
    """A space in which a model's starts are estimated besides those of before; and a chromosome.

    chromosome: (n_free,), of the space before, whose further starts are at their first samples.
    """
    space = replace(before.without_starts(), model=model).with_starts(records)
    bare = len(space.index)
    starts_before = dict(zip(before.estimated, chromosome[bare:].tolist(), strict=True))
    begun = space.with_nominal_starts(chromosome[:bare])
    starts = zip(space.estimated, begun[bare:].tolist(), strict=True)
    begun[bare:] = [starts_before.get(place, first) for place, first in starts]
    return space, begun
