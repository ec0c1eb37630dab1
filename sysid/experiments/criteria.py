"""What an experiment is to bring: scalar criteria of its information.

D: the entropy of the parameters falls most. A: the mean of the chosen quantities' variances is
least. E: the worst of them is. ``targets``: the quantities miss their deviations by the smallest
factor, the product of those that do (Atkinson, Donev and Tobias, "Optimum Experimental Designs,
with SAS", 2007, chapter 10). All are losses in logarithms, so that their mean over draws of the
parameters (ED-optimality: Pronzato and Walter, "Robust experiment design via stochastic
approximation", Mathematical Biosciences 75, 1985) lets no draw outweigh the others by its size.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.model import ModelError

Name = Literal["D", "A", "E"]

_MET = 1e-3  # what a target that is met counts, so that of designs that meet all one is the best


@dataclass(frozen=True)
class Criterion:
    """A loss of information matrices, less is better.

    prior: (n_free, n_free), information there is before. gradients: (n_draws, n_quantities,
    n_free), of the chosen quantities, in parts of their values, at each draw. targets:
    (n_quantities,), relative deviations that are wanted; none: infinite.
    """

    name: Name
    prior: FloatArray
    gradients: FloatArray
    targets: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.name not in get_args(Name):
            raise ModelError(
                f"unknown criterion {self.name!r}; choose from {', '.join(get_args(Name))}"
            )

    def losses(self, information: FloatArray) -> FloatArray:
        """Mean over the draws, (n,), of information (n, n_draws, n_free, n_free)."""
        total = information + self.prior
        if self.name == "D" and not len(self.targets):
            entropies: FloatArray = -0.5 * np.linalg.slogdet(total)[1].mean(axis=1)
            return entropies
        deviations = self.deviations(information)
        if len(self.targets):
            missed = np.log(deviations / self.targets)
            short: FloatArray = np.where(missed > 0.0, missed, _MET * missed).sum(axis=-1)
            return np.asarray(short.mean(axis=1))
        variances = deviations**2
        counted = variances.max(axis=-1) if self.name == "E" else variances.mean(axis=-1)
        losses: FloatArray = 0.5 * np.log(counted).mean(axis=1)
        return losses

    def deviations(self, information: FloatArray) -> FloatArray:
        """Relative deviations of the quantities, (n, n_draws, n_quantities)."""
        covariance = np.linalg.inv(information + self.prior)
        variances = np.einsum("dqi,ndij,dqj->ndq", self.gradients, covariance, self.gradients)
        deviations: FloatArray = np.sqrt(np.maximum(variances, 0.0))
        return deviations

    def met(self, information: FloatArray) -> bool:
        """Whether all targets are met at the first draw, of information (n_draws, ...)."""
        first = self.deviations(information[None])[0, 0]
        return bool(len(self.targets) and np.all(first <= self.targets))
