"""What an experiment is to bring: scalar criteria of its information.

D: the entropy of the parameters falls most. A: the mean of the chosen quantities' variances is
least. E: the worst of them is. ``targets``: the quantities miss their deviations by the smallest
factor, the product of those that do (Atkinson, Donev and Tobias, "Optimum Experimental Designs,
with SAS", 2007, chapter 10). balanced: the same, but what is met goes on counting, less, and
without targets there is one that makes a value usable: D spends all on quantities that a run tells
to 0.1 % and leaves others at 30 %. All are losses in logarithms, so that their mean over draws of
the parameters (ED-optimality: Pronzato and Walter, "Robust experiment design via stochastic
approximation", Mathematical Biosciences 75, 1985) lets no draw outweigh the others by its size.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.model import ModelError
from sysid.uncertainty.estimate import Z95

Name = Literal["D", "A", "E", "balanced"]

_MET = 1e-3  # what a target that is met counts, so that of designs that meet all one is the best
_BALANCED = 0.4  # what it counts where the rest of the time is to tell as much as it can
_USABLE = 0.1  # half width of a balanced interval without a target, in parts of the value


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
        if self.name == "balanced":
            wanted = self.targets if len(self.targets) else _USABLE / Z95
            return _missed(deviations / wanted, _BALANCED)
        if len(self.targets):
            return _missed(deviations / self.targets, _MET)
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


def _missed(parts: FloatArray, met: float) -> FloatArray:
    """Mean over the draws of how far deviations are from targets; met: what counts below them."""
    logarithms = np.log(parts)
    losses: FloatArray = np.where(logarithms > 0.0, logarithms, met * logarithms).sum(axis=-1)
    return np.asarray(losses.mean(axis=1))
