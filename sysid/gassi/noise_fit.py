"""A minimum refitted where inputs or the process are noisy: weights, noise, parameters in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid.arrays import FloatArray
from sysid.fitting.descent import TOLERANCE, Point
from sysid.fitting.innovations import Innovations
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import MOST_ITERATIONS, refine
from sysid.gassi.optima import LEAST_SHARE, QUICKLY, ROUGHLY, TINY, Optimum

_ROUNDS = 20
_STEADY = 1e-3  # share by which weights may still change
_RENEWED = 0.05  # change of a noise, where all else has come to rest, by which a fit goes on
_SWINGING = -0.5  # a round's change of a noise's logarithm in parts of the one before


@dataclass(frozen=True)
class NoiseFit:
    """Descends to a minimum by the noise of inputs, outputs and process from one of the error.

    given: the objective by the weights that were asked for. weighed: the same by its errors'.
    corrects, process: as of ``Innovations``.
    """

    given: Objective
    weighed: Objective
    corrects: bool
    process: FloatArray | None = None
    watch: Callable[[Point], None] | None = None

    def __call__(self, chromosome: FloatArray, noise: FloatArray | None = None) -> Optimum | None:
        """The minimum that chromosome (n_free,) leads to.

        noise: (n_outputs,), by which it is descended from first, where what is seen there would be
        too much. None where without corrections the inputs' noise would explain more than there is.
        """
        # Of its free run: a filter's errors are in parts of noise that may be next to none.
        factors = too_well(self.weighed.rms(chromosome[None])[0])
        settings: dict[str, Any] = {"corrects": self.corrects, "process": self.process}
        if noise is not None:
            assumed = Innovations.of(self.weighed, noise, near=chromosome, **settings)
            weights = self.given.weights * np.mean(assumed.scales, axis=0) / assumed.noise
            assumed = assumed.eased(chromosome).weighed(weights)
            chromosome = refine(assumed, chromosome, on_iteration=self.watch).chromosome
        fitted = Innovations.starting(self.weighed, chromosome, **settings)
        last = np.full(len(fitted.noise), np.inf)
        for _ in range(_ROUNDS):
            if not self.corrects and fitted.overwhelmed.any():
                return None
            rms = fitted.rms(chromosome[None])[0]
            if not np.isfinite(rms).all():  # a filter needs more steps here than there may be
                break
            weighed = fitted.weighed(self.given.weights / (factors * np.maximum(rms, TINY)))
            # Weights alone are steady by the noise of a poor place, too, where a filter corrects
            # next to nothing; those of a single output always are.
            steady = np.abs(last).max() < _STEADY and np.allclose(
                weighed.weights, fitted.weights, rtol=_STEADY
            )
            # Of no use to come to the end of what weights and noise will move.
            most, tolerance = (MOST_ITERATIONS, TOLERANCE) if steady else (QUICKLY, ROUGHLY)
            end = refine(
                weighed,
                chromosome,
                max_iterations=most,
                tolerance=tolerance,
                on_iteration=self.watch,
            )
            chromosome, rms, fitted = end.chromosome, end.rms, weighed
            if not steady:
                anew = fitted.settled(chromosome)
            else:
                # Where it began neither what bends nor what parabolas miss could be told well.
                anew = fitted.renewed(chromosome).eased(chromosome)
                alike = np.allclose(anew.noise, fitted.noise, rtol=_RENEWED)
                if alike and fitted.exact == anew.exact:
                    break
            fitted, last = towards(fitted, anew, last)
        return Optimum.of(fitted, chromosome, rms)


def foresees_more(optimum: Optimum, rival: Optimum) -> bool:
    """Whether its innovations are the less, by the lesser noise and trust of both filters."""
    fitted, before = optimum.objective, rival.objective
    assert isinstance(fitted, Innovations) and isinstance(before, Innovations)
    if optimum.feasible != rival.feasible:
        return optimum.feasible
    common = fitted.no_more_than(before).uneased
    rms = common.rms(np.stack([optimum.chromosome, rival.chromosome]))
    loss = np.log(np.maximum(rms, TINY)) @ (common.counts * (common.weights > 0.0))
    return bool(loss[0] < loss[1])


def too_well(rms: FloatArray) -> FloatArray:
    """By how much outputs are explained too well to count by what is left of them, (n_outputs,).

    rms: of free runs' errors, for noise of the inputs may leave hardly anything of an innovation.
    """
    with np.errstate(over="ignore"):  # where simulations failed
        factors: FloatArray = np.maximum(1.0, LEAST_SHARE * rms.max() / np.maximum(rms, TINY))
    return factors


def towards(
    fitted: Innovations, settled: Innovations, last: FloatArray
) -> tuple[Innovations, FloatArray]:
    """With the noise of the next round, and by how much its logarithms change, (n_outputs,).

    settled: with the noise that the parameters of this round ask for. last: change of the round
    before. Where one undoes most of the other, noise and parameters would go to and fro for ever:
    between the two is where a secant puts the end (Aitken).
    """
    change = np.log(settled.noise / fitted.noise)
    part = np.divide(change, last, out=np.zeros_like(change), where=last != 0.0)
    change = change / np.where(part < _SWINGING, 1.0 - part, 1.0)
    return settled.of_noise(fitted.noise * np.exp(change)), change
