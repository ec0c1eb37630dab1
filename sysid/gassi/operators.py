"""Operators of the genetic algorithms: initialisation, fitness, crossover, mutation, elitism.

A population is (n, n_free). The adaptive operators change it in place, chromosome after
chromosome. (The superscripts i and i+1 of Algorithms 4 and 5 are the population before and after
the step: taken literally, the mutation's right-hand side would undo the crossover.)
"""

import numpy as np

from sysid.arrays import BoolArray, FloatArray


def uniform(n: int, lower: FloatArray, upper: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Initial population uniformly distributed over the ranges, (n, n_free)."""
    return rng.uniform(lower, upper, size=(n, len(lower)))


def stratified(
    n: int, lower: FloatArray, upper: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Initial population by a Latin hypercube: one chromosome in each n-th part of a range."""
    cells = np.stack([rng.permutation(n) for _ in lower], axis=1)
    return lower + (cells + rng.random(cells.shape)) / n * (upper - lower)


def normalised_fitness(errors: FloatArray, flagged: BoolArray) -> FloatArray:
    """Algorithm 3: 1 for the lowest error, 0 for the highest and for flagged chromosomes."""
    fitness = np.zeros(len(errors))
    simulated = errors[~flagged]
    highest = simulated.max(initial=-np.inf)
    if highest <= 0.0:
        fitness[~flagged] = 1.0
        return fitness
    gains = 1.0 - simulated / highest
    gains -= gains.min()
    fitness[~flagged] = gains / gains.max() if gains.max() > 0.0 else gains
    return fitness


def adaptive_crossover(
    population: FloatArray, fitness: FloatArray, rng: np.random.Generator
) -> None:
    """Algorithm 4: the less fit of each of n random pairs moves towards the fitter."""
    n = len(population)
    ratio, fit = rng.random(), fitness.tolist()
    for a, b in rng.integers(n, size=(n, 2)).tolist():
        if fit[a] > fit[b]:
            population[b] = ratio * population[a] + (1.0 - ratio) * population[b]
        else:
            population[a] = ratio * population[b] + (1.0 - ratio) * population[a]


def adaptive_mutation(
    population: FloatArray, fitness: FloatArray, sigma: FloatArray, rng: np.random.Generator
) -> None:
    """Algorithm 5: those less fit than a common threshold r get r times normal noise of sigma."""
    n = len(population)
    threshold, fit = rng.random(), fitness.tolist()
    for a in rng.integers(n, size=n).tolist():
        if fit[a] < threshold:
            population[a] += threshold * rng.normal(0.0, sigma)


def replace_by_elite(
    population: FloatArray, elite: FloatArray, percent: float, rng: np.random.Generator
) -> None:
    """Replace a percentage of the chromosomes, at random, by the elite.

    At least one where the percentage is above 0, none where it is 0.
    """
    count = max(int(percent > 0.0), round(len(population) * percent / 100.0))
    population[rng.choice(len(population), size=count, replace=False)] = elite


def roulette(population: FloatArray, fitness: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Proportional selection (4.2): a population drawn in proportion to fitness."""
    total = fitness.sum()
    share = fitness / total if total > 0.0 else np.full(len(fitness), 1.0 / len(fitness))
    return population[rng.choice(len(population), size=len(population), p=share)]


def arithmetical_crossover(
    population: FloatArray, ratio: float, probability: float, rng: np.random.Generator
) -> None:
    """Replace random pairs by their two weighted means, (4.3) and (4.4)."""
    order = rng.permutation(len(population))
    for a, b in zip(order[0::2], order[1::2], strict=False):
        if rng.random() < probability:
            first, second = population[a].copy(), population[b].copy()
            population[a] = ratio * first + (1.0 - ratio) * second
            population[b] = ratio * second + (1.0 - ratio) * first


def uniform_mutation(
    population: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    probability: float,
    rng: np.random.Generator,
) -> None:
    """Draw each parameter anew from its range with a probability."""
    chosen = rng.random(population.shape) < probability
    population[chosen] = rng.uniform(lower, upper, size=population.shape)[chosen]
