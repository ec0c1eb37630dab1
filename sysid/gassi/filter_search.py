"""Where a filter's minimum may be that free runs do not lead to.

Over a long record the noise of the inputs adds up in a free run, until its error says little of the
parameters. A filter that trusts the outputs forgets, so that its innovations tell on few samples
and all over the ranges which parameters foresee them: chromosomes spread over the ranges are
compared by them on an excerpt, and the best are descended from.
"""

from __future__ import annotations

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.fitting.innovations import Innovations
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import begin, refine_each
from sysid.gassi.excerpt import Excerpt
from sysid.gassi.noise_fit import NoiseFit, foresees_more
from sysid.gassi.operators import stratified
from sysid.gassi.optima import Optimum
from sysid.uncertainty.colour import SUCCESSIVE, successive_correlation

SAMPLES = 3072  # that tell enough
_SPREAD = 512  # chromosomes
# Noise of an output whose innovations follow one another, in parts of what they show: their noise
# is what cannot be foreseen.
_LITTLE = 0.1
# Descents, iterations and tolerance of each stage.
_STAGES, _ROUGHLY = ((16, 5), (8, 15), (3, 30)), 1e-4


def better_by_filter(
    fit: NoiseFit, first: Optimum, others: list[FloatArray]
) -> tuple[Optimum, list[FloatArray]]:
    """A filter's minimum and starts (n_free,) for others, or better ones.

    Sought where its innovations could be foreseen, which are white at the right parameters.
    """
    fitted = first.objective
    assert isinstance(fitted, Innovations)
    little = coloured(fitted, first.chromosome)
    if not little.any():
        return first, others
    start, *rest = by_filter(fit.weighed, fitted, little)
    anew = fit(start)
    if anew is None or not foresees_more(anew, first):
        return first, others
    return anew, rest


def coloured(fitted: Innovations, chromosome: FloatArray) -> BoolArray:
    """Outputs that count whose innovations follow one another at a chromosome, (n_outputs,)."""
    steps = fitted.steps_needed(chromosome[None])
    innovations = fitted.residuals(chromosome[None], steps).values[..., 0]
    seen = np.concatenate([np.isfinite(record.outputs) for record in fitted.records])
    lengths = [record.n_samples for record in fitted.records]
    correlation = successive_correlation(innovations, seen, lengths)
    successive: BoolArray = (np.abs(correlation) > SUCCESSIVE) & (fitted.weights > 0.0)
    return successive


def by_filter(objective: Objective, fitted: Innovations, little: BoolArray) -> list[FloatArray]:
    """Chromosomes (n_free,) of minima that a filter has on an excerpt, the best first.

    objective: of the free runs' errors. fitted: a filter for its records. little: (n_outputs,),
    outputs of which that filter's noise is overrated.
    """
    noise = np.where(little, _LITTLE, 1.0) * fitted.noise
    filtered = fitted.of_noise(noise).weighed(objective.weights)
    excerpt = Excerpt.of(fitted.records, SAMPLES, every=False)
    if excerpt is None:
        return _minima(filtered)
    part = excerpt.of_all(filtered)
    return excerpt.on_all(part.space, _minima(part))[1]


def _minima(objective: Objective) -> list[FloatArray]:
    space = objective.space
    low, high = space.encode(np.stack([space.lower, space.upper]))
    spread = space.decode(stratified(_SPREAD, low, high, np.random.default_rng(0)))
    errors = objective.evaluate(spread)[0]
    errors[np.any(space.violations(spread) > 0.0, axis=1)] = np.inf
    starts = [spread[i] for i in np.argsort(errors) if np.isfinite(errors[i])]
    for most, iterations in _STAGES:
        descents = [begin(objective, start, tolerance=_ROUGHLY) for start in starts[:most]]
        minima = refine_each(objective, descents, max_iterations=iterations)
        starts = [end.chromosome for end in sorted(minima, key=lambda end: end.error)]
    return starts
