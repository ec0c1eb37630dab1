"""Objectives for inputs that are measured with noise.

A free run is driven by the noise n of its inputs, too, so that minimising |y - G (u0 + n)|^2 also
minimises |G n|^2: parameters that damp the noise are preferred to the true ones. Both objectives
here take that preference away, each by what the noise is known to do along the way, to first
order in it (see ``engine.filter_kernel``).

``Compensated`` takes the mean square c_j of G n out of each output's, as bias-compensated least
squares do (Stoica & Soderstrom, "Bias correction in least-squares identification", International
Journal of Control 35, 1982). It assumes nothing of the outputs' errors but that they are not the
inputs'. ``Innovations`` minimises the least that white noise of both kinds must have done,

    min over n of  sum n^2 / s + sum_j |y_j - g_j(u + n)|^2 / r_j  =  sum_j e_j^2 / s_j

with e_j the innovations of an extended Kalman filter and s_j their variances: the
errors-in-variables likelihood in which the true inputs are unknowns of their own, for a
regression Deming's. Its estimates vary less, as long as the outputs' noise is white.

The likelihood that CTSM-R maximises (Kristensen, Madsen & Jorgensen, "Parameter estimation in
stochastic grey-box models", Automatica 40, 2004) adds sum log s_j and takes n as independent of
the *measured* input. Of a measured one that is untrue, and the logarithm brings all of the free
run's bias back (docs/decisions/0013-innovations.md). The variances r_j therefore cannot come from
the same sum, which vanishes as they grow: each is such that the mean of e_j^2 / s_j is one, as it
is on average for the true parameters.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.engine.simulation import BatchResult, Residuals, Status
from sysid.fitting.objective import Objective

# An output's noise is at least this share of the error of its free run.
_LEAST_NOISE = 1e-2
_ROUNDS, _STEADY = 30, 1e-4  # of the outputs' noise, and its relative change at the end
_TINY = 1e-300
# A compensation does not enlarge an output's squares more than so many times.
_MOST_COMPENSATION = 10.0


class Compensated(Objective):
    """As ``Objective``, without what the inputs' noise does to the squares.

    total, caused: (n_outputs,), mean squares of the residuals and the part that the noise of the
    inputs accounts for at a reference, near which errors r_j^2 are multiplied by
    total / (total + c_j - caused): their slope there is that of r_j^2 - c_j.
    """

    total: FloatArray
    caused: FloatArray

    @classmethod
    def starting(cls, objective: Objective, chromosome: FloatArray) -> Self:
        """An objective's counterpart with a chromosome, (n_free,), as reference."""
        variant = cls.__new__(cls)
        vars(variant).update(vars(objective))
        return variant.settled(chromosome)

    def settled(self, chromosome: FloatArray) -> Self:
        """With another reference, (n_free,)."""
        free_run = self._free_run(chromosome[None], self.steps_needed(chromosome[None]))
        counts = np.maximum(self.counts, 1)
        total, caused = (v.sum(axis=(0, 1)) / counts for v in (free_run.sse, free_run.caused))
        return self._with(total=np.maximum(total, _TINY), caused=caused)

    def evaluate(self, chromosomes: FloatArray) -> tuple[FloatArray, BatchResult]:
        """As ``Objective.evaluate``, at the integration steps that the free runs need."""
        return _evaluated(self, chromosomes)

    def _simulated(
        self, chromosomes: FloatArray, steps: IntArray, *, keep: bool = True
    ) -> Residuals:
        free_run = self._free_run(chromosomes, steps)
        caused = free_run.caused.sum(axis=1) / np.maximum(self.counts, 1)
        kept = 1.0 + (caused - self.caused) / self.total
        factor = 1.0 / np.clip(kept, 1.0 / _MOST_COMPENSATION, None)  # (n, n_outputs)
        values = free_run.values * np.sqrt(factor).T
        return replace(free_run, values=values, sse=free_run.sse * factor[:, None])

    def _free_run(self, chromosomes: FloatArray, steps: IntArray) -> Residuals:
        vectors, starts = self.space.full(chromosomes), self._starts(chromosomes)
        endless = np.full(len(self.weights), np.inf)
        each = np.broadcast_to(steps, (len(vectors), len(self.records)))
        return self.simulator.innovations(
            vectors, self.records, self.scales, each, starts, endless
        )


class Innovations(Objective):
    """As ``Objective``, of innovations scaled to the outputs' own noise.

    noise: (n_outputs,), standard deviations of the outputs in their units.
    """

    noise: FloatArray

    @classmethod
    def of(cls, objective: Objective, noise: FloatArray) -> Self:
        """An objective's counterpart; noise: (n_outputs,)."""
        variant = cls.__new__(cls)
        vars(variant).update(vars(objective) | {"noise": noise})
        return variant

    @classmethod
    def starting(cls, objective: Objective, chromosome: FloatArray) -> Self:
        """Its counterpart with the noise that the innovations show at a chromosome, (n_free,)."""
        steps = objective.steps_needed(chromosome[None])[0]
        error = objective.in_units(objective.residuals(chromosome[None], steps).values[..., 0])
        return cls.of(objective, np.maximum(error, _TINY)).settled(chromosome)

    def settled(self, chromosome: FloatArray) -> Self:
        """With the noise that the innovations show at a chromosome, (n_free,)."""
        steps = self.steps_needed(chromosome[None])[0]
        settled, least = self, _LEAST_NOISE * self.noise
        for _ in range(_ROUNDS):
            innovations = settled.residuals(chromosome[None], steps).values[..., 0]
            before, noise = settled.noise, np.maximum(self.in_units(innovations), least)
            if not np.isfinite(noise).all():
                return self
            settled = self.of(self, noise)
            if np.allclose(noise, before, rtol=_STEADY):
                break
        return settled

    def evaluate(self, chromosomes: FloatArray) -> tuple[FloatArray, BatchResult]:
        """As ``Objective.evaluate``, at the integration steps that the free runs need."""
        return _evaluated(self, chromosomes)

    def _simulated(
        self, chromosomes: FloatArray, steps: IntArray, *, keep: bool = True
    ) -> Residuals:
        vectors, starts = self.space.full(chromosomes), self._starts(chromosomes)
        return self.simulator.innovations(
            vectors, self.records, self.scales, steps, starts, self.noise
        )


def _evaluated(
    objective: Innovations | Compensated, chromosomes: FloatArray
) -> tuple[FloatArray, BatchResult]:
    steps = objective.steps_needed(chromosomes)
    sse = objective._simulated(chromosomes, steps).sse
    failed = ~np.isfinite(sse).all(axis=(1, 2))
    sse = np.where(failed[:, None, None], np.inf, sse)
    status = np.where(failed, Status.UNBOUNDED, Status.OK)
    rms = np.sqrt(sse.sum(axis=1) / np.maximum(objective.counts, 1))
    return objective.error_of(rms), BatchResult(sse, status, steps.sum(axis=1))
