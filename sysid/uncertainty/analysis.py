"""Intervals of identified parameters, and what the data leave undetermined.

The singular values of the scaled output sensitivity are how far each direction of parameter
space can move before the outputs show it. Directions that move the outputs less than the noise
hides are not determined: the parameters in them get no interval, but the combinations that the
data do determine (products, sums) do.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.linalg import null_space

from sysid.arrays import FloatArray, IntArray
from sysid.fitting.objective import Objective
from sysid.problem.expressions import measuring_effort, product_text, product_unit, sum_text
from sysid.problem.given import covariance_factor
from sysid.uncertainty.directions import PART, Directions, directions
from sysid.uncertainty.estimate import Z95, Estimate, Why
from sysid.uncertainty.relations import (
    Kind,
    main_parameters,
    overlapping,
    overlooked_directions,
    relations,
    sparse,
)
from sysid.uncertainty.sensitivity import Sensitivity, sensitivity

_ALIKE = 0.05  # rivals closer than this are one
_WHOLE = 1e-3  # a factor this close to a whole number is meant to be one


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
    """Intervals of an identified chromosome, and what the data leave undetermined.

    parameters: an estimate for each free parameter (and estimated initial state). covariance:
    (n_free, n_free) of the coordinates (logarithms where searched so, else parts of the value),
    undetermined directions and parameters on a bound left out. singular_values: of the scaled
    sensitivity, falling. rank: how many directions the data determine. rivals: free parameters
    of other minima that the data do not tell from this one. factor: (n, n_free), independent
    changes of the parameters, one standard deviation each, and a unit of every exact tie: what a
    later stage is ``Given``.
    """

    parameters: tuple[Estimate, ...]
    ambiguities: tuple[Ambiguity, ...]
    covariance: FloatArray
    singular_values: FloatArray
    rank: int
    rivals: tuple[Mapping[str, float], ...] = ()
    factor: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def correlation(self) -> FloatArray:
        """Correlation of the free parameters, NaN where there is no variance."""
        deviation = np.sqrt(np.diag(self.covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation: FloatArray = self.covariance / np.outer(deviation, deviation)
        return correlation

    def determined(self) -> tuple[Estimate, ...]:
        """All quantities with an interval: parameters, then combinations."""
        combined = itertools.chain(*(a.determined for a in self.ambiguities))
        return (*(p for p in self.parameters if not p.why), *combined)


def uncertainty(
    objective: Objective, chromosome: FloatArray, rivals: Sequence[FloatArray] = ()
) -> Uncertainty:
    """Intervals, ambiguities and what is determined at an identified chromosome, (n_free,).

    The estimate is taken as the minimum of the objective; the colour of its residuals and the
    records' zero errors enter the covariance. rivals: other minima that explain the data as well;
    a parameter with another value there has no interval.
    """
    local = sensitivity(objective, chromosome)
    determined = directions(local)
    inert = overlooked_directions(local, determined.undetermined, rivals)
    if len(inert):
        local = replace(local, slopes=local.slopes - local.slopes @ inert.T @ inert)
        determined = directions(local)
    analysis = _Analysis(local, determined)
    result = Uncertainty(
        tuple(analysis.parameter(j) for j in range(len(chromosome))),
        tuple(analysis.ambiguities()),
        determined.covariance,
        determined.singular_values,
        determined.rank,
        factor=analysis.factor(),
    )
    named = [dict(zip(objective.space.names, rival.tolist(), strict=True)) for rival in rivals]
    return _among_rivals(result, named)


def _among_rivals(result: Uncertainty, rivals: Sequence[Mapping[str, float]]) -> Uncertainty:
    """Without the intervals that exclude the value in a rival minimum."""

    def disputed(estimate: Estimate) -> bool:
        return any(estimate.excludes(rival) for rival in rivals)

    several = [e for e in result.parameters if disputed(e)]
    names = tuple(e.name for e in sorted(several, key=lambda e: measuring_effort(e.unit)))
    parameters = tuple(
        replace(e, std=None, low=None, high=None, why="rival") if e in several else e
        for e in result.parameters
    )
    ambiguities = [
        replace(a, determined=tuple(e for e in a.determined if not disputed(e)))
        for a in result.ambiguities
    ]
    if names:
        ambiguities.insert(0, Ambiguity("rival", names, (), names[:1]))
    # Of those that differ in no disputed parameter the first stands for all.
    unlike: list[Mapping[str, float]] = []
    values: list[list[float]] = []
    for rival in rivals:
        named = [rival[name] for name in names]
        apart = any(e.excludes(rival) for e in several)
        if apart and not any(np.allclose(named, before, rtol=_ALIKE) for before in values):
            unlike.append(rival)
            values.append(named)
    return replace(
        result, parameters=parameters, ambiguities=tuple(ambiguities), rivals=tuple(unlike)
    )


class _Analysis:
    """Estimates and ambiguities from the directions that the data determine."""

    def __init__(self, local: Sensitivity, determined: Directions) -> None:
        self.determined = determined
        self.exact, self.vague = relations(local, determined)
        self.chromosome, self.increments = local.chromosome, local.increments
        self.log = local.objective.space.log
        self.names = local.objective.space.names
        self.units = [parameter.unit for parameter in local.objective.space.parameters]
        # Relative change of each parameter per unit of its coordinate; none of what is zero.
        divisors = np.where(self.chromosome != 0.0, self.chromosome, np.inf)
        self.relative_increments = self.increments / divisors

    def factor(self) -> FloatArray:
        """As of ``Uncertainty``."""
        ties = np.array([relation.vector for relation in self.exact]).reshape(-1, len(self.names))
        return covariance_factor(self.determined.covariance, ties, self.increments)

    def parameter(self, j: int) -> Estimate:
        """Estimate of a free parameter."""
        why: Why = ""
        if self.determined.held[j]:
            why = "bound"
        elif any(relation.vector[j] for relation in self.exact):
            why = "tied"
        elif self.determined.undetermined_share[j] > PART:
            why = "vague"
        if why:
            value, terms = float(self.chromosome[j]), ((self.names[j], 1.0),)
            return Estimate(self.names[j], self.units[j], value, terms, "product", why=why)
        weights = np.eye(len(self.chromosome))[j]
        return self._product(weights) if self.log[j] else self._sum(weights)

    def ambiguities(self) -> Iterator[Ambiguity]:
        """Exact relations that share parameters together, each vague direction by itself."""
        for places in overlapping([relation.vector != 0.0 for relation in self.exact]):
            members = [self.exact[i] for i in places]
            vectors = np.stack([relation.vector for relation in members])
            group = np.flatnonzero(vectors.any(axis=0))
            if all(relation.kind == "sum" for relation in members):
                yield self._ambiguity("sum", group, vectors, self._sums(group, vectors[:, group]))
            else:
                products = self._products(group, len(group) - len(members))
                yield self._ambiguity("product", group, vectors, products)
        for vector in self.vague:
            yield self._ambiguity("vague", main_parameters(vector), vector[None], [])

    def _product(self, exponents: FloatArray) -> Estimate:
        """Estimate of a product of powers of the parameters."""
        used = np.flatnonzero(exponents)
        value = float(np.prod(self.chromosome[used] ** exponents[used]))
        deviation = self._deviation(exponents * self.relative_increments)
        low, high = sorted(value * np.exp(factor * deviation) for factor in (-Z95, Z95))
        unit = self.units[used[0]]
        if len(used) > 1:
            unit = product_unit((self.units[i], exponents[i]) for i in used)
        terms, std = self._terms(exponents), abs(value) * deviation
        return Estimate(product_text(terms), unit, value, terms, "product", std, low, high)

    def _sum(self, factors: FloatArray) -> Estimate:
        """Estimate of a weighted sum of the parameters."""
        value = float(factors @ self.chromosome)
        deviation = self._deviation(factors * self.increments)
        low, high = value - Z95 * deviation, value + Z95 * deviation
        unit = self.units[np.flatnonzero(factors)[0]]
        terms = self._terms(factors)
        return Estimate(sum_text(terms), unit, value, terms, "sum", deviation, low, high)

    def _terms(self, weights: FloatArray) -> tuple[tuple[str, float], ...]:
        return tuple((self.names[i], float(weights[i])) for i in np.flatnonzero(weights))

    def _deviation(self, direction: FloatArray) -> float:
        return float(np.sqrt(max(float(direction @ self.determined.covariance @ direction), 0.0)))

    def _ambiguity(
        self, kind: Kind, group: IntArray, vectors: FloatArray, determined: list[Estimate]
    ) -> Ambiguity:
        group = np.array(sorted(group, key=lambda i: measuring_effort(self.units[i])))
        measure: list[int] = []
        for i in group.tolist():
            if np.linalg.matrix_rank(vectors[:, [*measure, i]]) > len(measure):
                measure.append(i)
        parameters, measured = (tuple(self.names[i] for i in places) for places in (group, measure))
        return Ambiguity(kind, parameters, tuple(determined), measured)

    def _sums(self, group: IntArray, vectors: FloatArray) -> list[Estimate]:
        """Sums of the group's parameters that the data determine, orthogonal to the vectors."""
        sums = []
        for direction in sparse(null_space(vectors).T):
            factors = np.zeros(len(self.chromosome))
            factors[group] = direction / self.increments[group]
            used = factors[np.flatnonzero(factors)]
            # Factors in parts of the smallest, the first of them positive.
            factors /= np.min(np.abs(used)) * np.sign(used[0])
            whole = np.round(factors)
            factors = np.where(np.abs(factors - whole) < _WHOLE, whole, factors)
            if self._is_determined(factors * self.increments):
                sums.append(self._sum(factors))
        return sums

    def _products(self, group: IntArray, count: int) -> list[Estimate]:
        """Simple products of the group's parameters that the data determine, at most count."""
        chosen: list[FloatArray] = []
        for powers in _simple_exponents(len(group)):
            if len(chosen) == count:
                break
            exponents = np.zeros(len(self.chromosome))
            exponents[group] = powers
            trial = np.array([*chosen, exponents])
            is_determined = self._is_determined(exponents * self.relative_increments)
            if is_determined and np.linalg.matrix_rank(trial) > len(chosen):
                chosen.append(exponents)
        return [self._product(exponents) for exponents in chosen]

    def _is_determined(self, direction: FloatArray) -> bool:
        """Whether the data determine what changes so with the coordinates."""
        outside = np.sum((self.determined.undetermined @ direction) ** 2) / np.sum(direction**2)
        return bool(outside < PART)


def _simple_exponents(n: int) -> Iterator[FloatArray]:
    """Exponents of simple products of n factors, the simplest first: squares after all others."""
    for powers in ((1.0, -1.0), (1.0, -1.0, 2.0, -2.0)):
        for size in (1, 2, 3):
            for places in itertools.combinations(range(n), size):
                for chosen in itertools.product(powers, repeat=size):
                    if chosen[0] > 0.0 and min(map(abs, chosen)) == 1.0:
                        exponents = np.zeros(n)
                        exponents[list(places)] = chosen
                        yield exponents
