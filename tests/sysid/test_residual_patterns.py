"""Patterns of residuals: larger in fast motion, and what only looks like that."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from sysid.judging.residual_patterns import errors_by_speed

N, SEEDS = 2000, 60


def walking(rng, pole, columns=1):
    """Noise (N, columns) with a memory, of deviation 1."""
    noise = lfilter([1.0], [1.0, -pole], rng.standard_normal((N, columns)), axis=0)
    return noise / noise.std(axis=0)


def share_found(error_of):
    """Share of the seeds with which errors (N, 1) of motion (N, 1) are larger as it is fast."""
    found = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng([7, seed])
        motion = np.cumsum(walking(rng, 0.99), axis=0)
        error = error_of(rng, np.abs(np.gradient(motion, axis=0)))
        found += errors_by_speed(error, motion, np.zeros((N, 1, 0)))[0] > 0.0
    return found / SEEDS


def test_errors_that_wander_beside_a_slow_motion_are_not_larger_for_it():
    assert share_found(lambda rng, speed: walking(rng, 0.99)) < 0.04


def test_errors_that_grow_with_the_speed_do_so_by_more_than_chance():
    assert share_found(lambda rng, speed: (0.3 + speed) * walking(rng, 0.0)) > 0.85
    assert share_found(lambda rng, speed: (0.1 + speed) * walking(rng, 0.5)) > 0.85
