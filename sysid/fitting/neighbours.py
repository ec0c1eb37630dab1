"""Neighbours of a point, by which slopes are differences.

A start acts on the residuals of its record alone. So starts of different records are moved by the
same neighbour, each of which tells the slopes of its own rows: thirty records with a start each
take one simulation more than one of them (Curtis, Powell and Reid, "On the estimation of sparse
Jacobian matrices", IMA Journal of Applied Mathematics 13, 1974).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.fitting.objective import Objective
from sysid.fitting.slopes import SlopeBlock, Slopes


@dataclass(frozen=True)
class Neighbours:
    """places: (n_free,), which of the neighbours moves each coordinate.

    blocks: rows of each record, and coordinates that act on them, if not all do.
    """

    places: IntArray
    blocks: tuple[tuple[slice, IntArray], ...] = ()

    @classmethod
    def of(cls, objective: Objective) -> Self:
        """Those of an objective, as few as there may be."""
        shared, n_free = len(objective.space.index), len(objective.space.parameters)
        places, blocks = np.arange(n_free), objective.blocks
        if max(len(columns) for _, columns in blocks) == n_free:
            return cls(places)
        for _, columns in blocks:
            places[columns[shared:]] = np.arange(shared, len(columns))
        return cls(places, tuple(blocks))

    @property
    def count(self) -> int:
        """How many neighbours there are."""
        return int(self.places.max(initial=-1)) + 1

    def around(self, at: FloatArray, moves: FloatArray) -> FloatArray:
        """Search coordinates of a point (n_free,) and of its neighbours, (1 + n, n_free).

        moves: (n_free,), of each coordinate.
        """
        rows = np.zeros((self.count, len(at)))
        rows[self.places, np.arange(len(at))] = moves
        return np.vstack([at, at + rows])

    def slopes(self, values: FloatArray, distance: FloatArray) -> Slopes:
        """Slopes by residuals there, (n_residuals, n_outputs, 1 + n).

        distance: (n_free,), of each coordinate in parts of the ranges.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # at the edge of stability
            changes = values[..., 1:] - values[..., :1]
            if not self.blocks:
                return Slopes.of(changes / distance)
            return Slopes(
                tuple(
                    SlopeBlock(
                        rows, columns, changes[rows][..., self.places[columns]] / distance[columns]
                    )
                    for rows, columns in self.blocks
                ),
                len(distance),
            )
