"""What is known of the parameters before an experiment, in search coordinates."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.model import ModelError
from sysid.problem.space import SearchSpace

_ATTEMPTS = 200  # draws for each one that is to keep the model's constraints


@dataclass(frozen=True)
class Prior:
    """Values of the free parameters (n_free,), and the covariance of their search coordinates.

    covariance: (n_free, n_free), of logarithms where a parameter is searched by logarithm.

    >>> from sysid.examples import lag
    >>> prior = Prior.of_ranges(SearchSpace.of(lag()))
    >>> prior.values.tolist(), np.sqrt(np.diag(prior.covariance)).round(2).tolist()
    ([2.0, 0.05], [1.33, 1.33])
    """

    values: FloatArray
    covariance: FloatArray

    @classmethod
    def of_ranges(cls, space: SearchSpace) -> Self:
        """Nominal values, and the variance of a uniform distribution over each range."""
        nominal = np.array([parameter.nominal for parameter in space.parameters])
        values = np.clip(nominal, space.lower, space.upper)
        return cls(values, np.diag(space.width**2 / 12.0))

    def information(self) -> FloatArray:
        """Inverse of the covariance, (n_free, n_free)."""
        return np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    def draws(self, space: SearchSpace, n: int, rng: np.random.Generator) -> FloatArray:
        """Plausible chromosomes, (n, n_free), the first of them the values themselves.

        Normal around the values, cut to the ranges; raises ModelError where hardly any keeps the
        model's constraints.
        """
        if not space.feasible(self.values):
            raise ModelError("the values that a design starts from break the model's constraints")
        kept, at = [self.values], space.encode(self.values)
        root = np.linalg.cholesky(self.covariance)
        ends = space.coded_lower, space.coded_lower + space.width
        for _ in range(_ATTEMPTS * n):
            if len(kept) == n:
                return np.array(kept)
            coded = np.clip(at + root @ rng.standard_normal(len(at)), *ends)
            chromosome = space.decode(coded)
            if space.feasible(chromosome):
                kept.append(chromosome)
        raise ModelError(
            "hardly any parameters drawn from what is known keep the model's constraints; narrow "
            "the ranges"
        )
