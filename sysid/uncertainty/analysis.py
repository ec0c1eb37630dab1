"""What the data say about identified parameters, how surely, and what they cannot say.

The singular values of the scaled output sensitivity tell how far each direction of parameter
space can move before the outputs show it. Directions that move the outputs less than the noise
hides are not determined: the parameters in them get no interval, but the combinations that the
data do determine (products, sums) do.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import null_space

from sysid.arrays import FloatArray, IntArray
from sysid.fitting.objective import Objective
from sysid.problem.space import SearchSpace
from sysid.uncertainty.directions import PART, Directions, directions
from sysid.uncertainty.estimate import Z95, Estimate, Why, product_text, sum_text
from sysid.uncertainty.relations import (
    Kind,
    Relation,
    named,
    overlapping,
    overlooked,
    relations,
    sparse,
)
from sysid.uncertainty.sensitivity import common_steps, coordinate_units, sensitivity
from sysid.uncertainty.units import product_unit

_ALIKE = 0.05  # rivals closer than this are one
_WHOLE = 1e-3  # a factor this close to a whole number is meant to be one

# Units of what a lab measures with a meter, a scale or a data sheet, easiest first.
_MEASURABLE = ("ohm", "H", "kg", "m", "N*m/A", "V*s/rad", "kg*m^2", "N/m")


@dataclass(frozen=True)
class Ambiguity:
    """Parameters of which only combinations act on the outputs.

    kind: ``product`` and ``sum`` are exact, tried by moving the parameters along them; ``vague``
    is a direction that the noise hides; ``rival`` are those that differ between minima that the
    data do not tell apart. determined: the combinations that have an interval.
    measure: the parameters whose measurement by other means would resolve it, as many as there
    are directions to resolve, what is easiest to measure first.
    """

    kind: Kind | Literal["rival"]
    parameters: tuple[str, ...]
    determined: tuple[Estimate, ...]
    measure: tuple[str, ...]


@dataclass(frozen=True)
class Uncertainty:
    """All that the residuals and sensitivities tell about a chromosome.

    parameters: one estimate for each free parameter (and estimated initial state). covariance:
    (n_free, n_free) of the coordinates (logarithms where searched so, else parts of the value),
    undetermined directions and parameters on a bound left out. singular_values: of the scaled
    sensitivity, falling. rank: how many directions the data determine. rivals: free parameters
    of other minima that the data do not tell from this one.
    """

    parameters: tuple[Estimate, ...]
    ambiguities: tuple[Ambiguity, ...]
    covariance: FloatArray
    singular_values: FloatArray
    rank: int
    rivals: tuple[Mapping[str, float], ...] = ()

    def correlation(self) -> FloatArray:
        """Correlation of the free parameters, NaN where there is no variance."""
        deviation = np.sqrt(np.diag(self.covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation: FloatArray = self.covariance / np.outer(deviation, deviation)
        return correlation

    def determined(self) -> tuple[Estimate, ...]:
        """Every quantity with an interval: parameters of their own, then combinations."""
        combined = itertools.chain(*(a.determined for a in self.ambiguities))
        return (*(p for p in self.parameters if not p.why), *combined)


def uncertainty(
    objective: Objective, chromosome: FloatArray, rivals: Sequence[FloatArray] = ()
) -> Uncertainty:
    """Intervals, ambiguities and what is determined at an identified chromosome, (n_free,).

    The estimate is taken as the minimum of the objective; the colour of its residuals and the
    records' zero errors enter the covariance. rivals: other minima that explain the data as well;
    what is another there has no interval.
    """
    steps = common_steps(objective, chromosome)
    found = sensitivity(objective, chromosome, steps)
    ends = objective.space.on_bound(chromosome)
    told = directions(objective, chromosome, steps, found, ends)
    units = coordinate_units(objective, chromosome)
    slope = np.where(objective.space.log, chromosome, units)
    still = overlooked(objective, chromosome, steps, found, slope, told.lost, rivals)
    if len(still):
        found = replace(found, slopes=found.slopes - found.slopes @ still.T @ still)
        told = directions(objective, chromosome, steps, found, ends)
    hidden = relations(objective, chromosome, steps, found, slope, told)
    result = _Teller(objective.space, chromosome, slope, told, hidden).result()
    names = objective.space.names
    return _beside(result, [dict(zip(names, rival.tolist(), strict=True)) for rival in rivals])


def _beside(result: Uncertainty, rivals: Sequence[Mapping[str, float]]) -> Uncertainty:
    """Without the intervals of what is another in a rival minimum."""

    def other(estimate: Estimate, rival: Mapping[str, float]) -> bool:
        if estimate.low is None or estimate.high is None:
            return False
        return not estimate.low <= estimate.at(rival) <= estimate.high

    def open_(estimate: Estimate) -> bool:
        return any(other(estimate, rival) for rival in rivals)

    several = [e for e in result.parameters if open_(e)]
    names = tuple(e.name for e in sorted(several, key=lambda e: _effort(e.unit)))
    parameters = tuple(
        replace(e, std=None, low=None, high=None, why="rival") if open_(e) else e
        for e in result.parameters
    )
    ambiguities = [
        replace(a, determined=tuple(e for e in a.determined if not open_(e)))
        for a in result.ambiguities
    ]
    if names:
        ambiguities.insert(0, Ambiguity("rival", names, (), names[:1]))
    apart = [rival for rival in rivals if any(other(e, rival) for e in several)]
    return replace(
        result,
        parameters=parameters,
        ambiguities=tuple(ambiguities),
        rivals=tuple(_unlike(apart, names)),
    )


def _unlike(
    rivals: Sequence[Mapping[str, float]], names: Sequence[str]
) -> list[Mapping[str, float]]:
    """Those that differ from each other in some of the named parameters."""
    kept: list[Mapping[str, float]] = []
    for rival in rivals:
        values = [rival[name] for name in names]
        if not any(
            np.allclose(values, [known[name] for name in names], rtol=_ALIKE) for known in kept
        ):
            kept.append(rival)
    return kept


@dataclass(frozen=True)
class _Teller:
    """Turns directions into statements about parameters.

    slope: (n_free,), change of each parameter per unit of its coordinate.
    """

    space: SearchSpace
    chromosome: FloatArray
    slope: FloatArray
    told: Directions
    hidden: list[Relation]

    def result(self) -> Uncertainty:
        """Everything together."""
        n = len(self.chromosome)
        return Uncertainty(
            tuple(self._parameter(j) for j in range(n)),
            tuple(self._ambiguities()),
            self.told.covariance,
            self.told.singular_values,
            self.told.rank,
        )

    @property
    def _relative_slope(self) -> FloatArray:
        """Relative change of each parameter per unit of its coordinate; none of what is zero."""
        nonzero = self.chromosome != 0.0
        return np.divide(self.slope, self.chromosome, out=np.zeros(len(nonzero)), where=nonzero)

    def _parameter(self, j: int) -> Estimate:
        one = np.zeros(len(self.chromosome))
        one[j] = 1.0
        why: Why = ""
        if self.told.held[j]:
            why = "bound"
        elif any(relation.exact and relation.support[j] for relation in self.hidden):
            why = "tied"
        elif np.sum(self.told.lost[:, j] ** 2) > PART:
            why = "vague"
        if why:
            parameter = self.space.parameters[j]
            value = float(self.chromosome[j])
            terms = ((parameter.name, 1.0),)
            return Estimate(parameter.name, parameter.unit, value, terms, "product", why=why)
        return self._product(one) if self.space.log[j] else self._sum(one)

    def _product(self, exponents: FloatArray) -> Estimate:
        """Estimate of a product of powers of the parameters."""
        used = np.flatnonzero(exponents)
        value = float(np.prod(self.chromosome[used] ** exponents[used]))
        deviation = self._deviation(exponents * self._relative_slope)
        terms = self._terms(exponents)
        ends = value * np.exp(-Z95 * deviation), value * np.exp(Z95 * deviation)
        units = [self.space.parameters[i].unit for i in used]
        unit = (
            units[0] if len(used) == 1 else product_unit(zip(units, exponents[used], strict=True))
        )
        return Estimate(
            product_text(terms), unit, value, terms, "product",
            abs(value) * deviation, min(ends), max(ends),
        )  # fmt: skip

    def _sum(self, factors: FloatArray) -> Estimate:
        """Estimate of a weighted sum of the parameters."""
        used = np.flatnonzero(factors)
        value = float(factors @ self.chromosome)
        deviation = self._deviation(factors * self.slope)
        terms = self._terms(factors)
        return Estimate(
            sum_text(terms), self.space.parameters[used[0]].unit, value, terms, "sum",
            deviation, value - Z95 * deviation, value + Z95 * deviation,
        )  # fmt: skip

    def _terms(self, weights: FloatArray) -> tuple[tuple[str, float], ...]:
        used = np.flatnonzero(weights)
        return tuple((self.space.parameters[i].name, float(weights[i])) for i in used)

    def _deviation(self, direction: FloatArray) -> float:
        return float(np.sqrt(max(float(direction @ self.told.covariance @ direction), 0.0)))

    def _ambiguities(self) -> list[Ambiguity]:
        """Exact relations that share parameters as one, each vague direction by itself."""
        exact = [relation for relation in self.hidden if relation.exact]
        groups = overlapping([relation.support for relation in exact])
        found = [self._exact([exact[i] for i in members]) for members in groups]
        for relation in self.hidden:
            if not relation.exact:
                group = named(relation.vector)
                found.append(self._ambiguity("vague", group, [relation], []))
        return found

    def _exact(self, members: list[Relation]) -> Ambiguity:
        group = np.flatnonzero(np.any([relation.support for relation in members], axis=0))
        sums = all(relation.kind == "sum" for relation in members)
        if sums:
            determined = self._sums(group, np.stack([r.vector[group] for r in members]))
        else:
            determined = self._products(group, len(group) - len(members))
        return self._ambiguity("sum" if sums else "product", group, members, determined)

    def _ambiguity(
        self, kind: Kind, group: IntArray, members: list[Relation], determined: list[Estimate]
    ) -> Ambiguity:
        own = sorted(group, key=lambda i: _effort(self.space.parameters[i].unit))
        vectors = np.stack([relation.vector for relation in members])
        measure: list[int] = []
        for i in own:
            if np.linalg.matrix_rank(vectors[:, [*measure, i]]) > len(measure):
                measure.append(int(i))
        names = self.space.names
        return Ambiguity(
            kind,
            tuple(names[i] for i in own),
            tuple(determined),
            tuple(names[i] for i in measure),
        )

    def _sums(self, group: IntArray, vectors: FloatArray) -> list[Estimate]:
        """Sums of the group's parameters that the data determine.

        vectors: (n_relations, n_group), directions that leave them alone.
        """
        chosen = []
        for direction in sparse(null_space(vectors).T):
            factors = np.zeros(len(self.chromosome))
            factors[group] = direction / self.slope[group]
            used = np.flatnonzero(factors)
            # Factors in parts of the smallest, the first of them positive.
            smallest = np.min(np.abs(factors[used])) * np.sign(factors[used[0]])
            factors /= smallest
            whole = np.round(factors)
            factors = np.where(np.abs(factors - whole) < _WHOLE, whole, factors)
            if self._determined(factors * self.slope):
                chosen.append(factors)
        return [self._sum(factors) for factors in chosen]

    def _determined(self, direction: FloatArray) -> bool:
        """Whether the data determine what changes so with the coordinates."""
        outside = np.sum((self.told.lost @ direction) ** 2) / np.sum(direction**2)
        return bool(outside < PART)

    def _products(self, group: IntArray, count: int) -> list[Estimate]:
        """Simple products of the group's parameters that the data determine, at most count."""
        chosen: list[FloatArray] = []
        for exponents in _simple_exponents(len(group)):
            if len(chosen) == count:
                break
            whole = np.zeros(len(self.chromosome))
            whole[group] = exponents
            direction = whole * self._relative_slope
            if not self._determined(direction):
                continue
            if np.linalg.matrix_rank(np.array([*chosen, whole])) > len(chosen):
                chosen.append(whole)
        return [self._product(exponents) for exponents in chosen]


def _effort(unit: str) -> int:
    """Rank of a unit by how easily a lab measures what has it."""
    return _MEASURABLE.index(unit) if unit in _MEASURABLE else len(_MEASURABLE)


def _simple_exponents(n: int) -> list[FloatArray]:
    """Exponents of simple products of n factors, the simplest first: squares after all others."""
    found = []
    for powers in ((1.0, -1.0), (1.0, -1.0, 2.0, -2.0)):
        for size in (1, 2, 3):
            for places in itertools.combinations(range(n), size):
                for chosen in itertools.product(powers, repeat=size):
                    if chosen[0] > 0.0 and min(map(abs, chosen)) == 1.0:
                        exponents = np.zeros(n)
                        exponents[list(places)] = chosen
                        found.append(exponents)
    return found
