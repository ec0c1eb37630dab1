"""What a profile moves: a search coordinate, or an expression of several parameters."""

import itertools
from typing import Protocol

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.descent import Restriction
from sysid.problem.space import SearchSpace
from sysid.uncertainty.estimate import Invariant
from sysid.uncertainty.ties import coded_gradient, named_columns, named_values


class Profiled(Protocol):
    """A quantity on the scale on which it is moved, between its ends.

    width: of the range searched, on that scale.
    """

    ends: tuple[float, float]
    width: float

    def at(self, coded: FloatArray) -> float:
        """Its place on that scale at search coordinates (n_free,)."""

    def slope(self, coded: FloatArray) -> FloatArray:
        """Its changes with search coordinates, (n_free,), at such (n_free,)."""

    def value(self, place: float) -> float:
        """Its value at a place."""

    def kept(self, place: float, stiffness: float) -> Restriction:
        """What keeps it at a place.

        stiffness: residual per unit of the scale, of what cannot be held otherwise.
        """


class Coordinate:
    """A free parameter on the scale on which it is searched, which is held."""

    def __init__(self, space: SearchSpace, index: int) -> None:
        self._space, self._index = space, index
        lower, upper = space.coded_bounds
        self.ends = float(lower[index]), float(upper[index])
        self.width = float(space.width[index])

    def at(self, coded: FloatArray) -> float:
        """The search coordinate."""
        return float(coded[self._index])

    def slope(self, coded: FloatArray) -> FloatArray:
        """One of the search coordinate itself."""
        slope = np.zeros(len(coded))
        slope[self._index] = 1.0
        return slope

    def value(self, place: float) -> float:
        """The parameter."""
        return float(np.exp(place)) if self._space.log[self._index] else place

    def kept(self, place: float, stiffness: float) -> Restriction:
        """Between bounds that are one."""
        return Restriction(held=(self._index, place))


class Expression:
    """An expression of free parameters, or its logarithm, which is tethered."""

    def __init__(self, space: SearchSpace, combination: Invariant, log: bool) -> None:
        self._space, self._combination, self._log = space, combination, log
        members = [space.names.index(name) for name in combination.names if name in space.names]
        # Products and sums are largest and smallest in corners of the ranges.
        middle = space.coded_lower + 0.5 * space.width
        for bounds in (space.coded_bounds, (space.coded_lower, space.coded_lower + space.width)):
            corners = np.repeat(middle[None], 2 ** len(members), axis=0)
            corners[:, members] = list(itertools.product(*np.array(bounds).T[members]))
            places = self._places(space.decode(corners))
            self.ends = float(np.nanmin(places)), float(np.nanmax(places))
            if np.isfinite(self.ends).all():
                break
        self.width = self.ends[1] - self.ends[0]

    def at(self, coded: FloatArray) -> float:
        """The expression's value, or its logarithm."""
        return float(self._places(self._space.decode(coded[None]))[0])

    def slope(self, coded: FloatArray) -> FloatArray:
        """By the parameters that are in it, and those tied to them."""
        chromosome = self._space.decode(coded)
        slope = coded_gradient(self._combination, self._space, chromosome)
        if not self._log:
            return slope
        return slope / self._combination.value(named_values(self._space, chromosome))

    def value(self, place: float) -> float:
        """The expression's value."""
        return float(np.exp(place)) if self._log else place

    def kept(self, place: float, stiffness: float) -> Restriction:
        """By one residual more."""
        return Restriction(tether=lambda rows: stiffness * (self._places(rows) - place))

    def _places(self, chromosomes: FloatArray) -> FloatArray:
        """Places of chromosomes, (n,)."""
        names, columns = self._combination.names, named_columns(self._space, chromosomes)
        rows = zip(*(columns[name].tolist() for name in names), strict=True)
        values = np.array(
            [self._combination.value(dict(zip(names, row, strict=True))) for row in rows]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(values) if self._log else values
