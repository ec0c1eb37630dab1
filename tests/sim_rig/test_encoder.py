from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from sim_rig.device.encoder import EncoderCounter

PER_TURN = 8192
RATE = 800.0
PER_TICK = 16
STEP = 1.0 / (RATE * PER_TICK)
COUNT = 2.0 * math.pi / PER_TURN  # rad


def moving_at(angle, t):
    """Angle and speed, (n, 2)."""
    return np.stack([angle(t), (angle(t + 1e-6) - angle(t - 1e-6)) / 2e-6], axis=1)


def latch(angle, duration, cuts=(), origin=0.0, phase=0.0):
    """Counts and rates of a motion angle(t) [rad], latched in one call or several."""
    ticks = round(duration * RATE)
    t = origin + np.arange(ticks * PER_TICK + 1) * STEP
    angles = angle(t)
    moving = moving_at(angle, t)
    counter = EncoderCounter(PER_TURN, phase)
    edges = [0, *cuts, ticks]
    parts = [
        counter.latch(
            moving[a * PER_TICK : b * PER_TICK],
            moving[b * PER_TICK],
            origin,
            a * PER_TICK,
            STEP,
            PER_TICK,
        )
        for a, b in pairwise(edges)
    ]
    counts, rates = (np.concatenate(column) for column in zip(*parts, strict=True))
    return counts, rates, angles[: ticks * PER_TICK : PER_TICK]


def wobble(t):
    return 0.3 * np.sin(9.0 * t) + 0.02 * np.sin(140.0 * t) - 0.1


def test_counts_are_the_floor_of_the_angle():
    counts, _, angles = latch(wobble, 1.0)
    np.testing.assert_array_equal(counts, np.floor(angles / COUNT))
    assert counts.min() < 0 < counts.max()


@pytest.mark.parametrize("speed", [0.05, 0.5, 3.0, 40.0, -0.05, -0.5, -3.0, -40.0])
def test_the_rate_is_exact_at_constant_speed(speed):
    counts, rates, _ = latch(lambda t: 0.123 + speed * t, 0.5)
    expected = speed / COUNT
    # Two edges have to pass first.
    settled = rates[np.arange(len(rates)) / RATE > 2.5 / abs(expected)]
    assert len(settled) > 100
    np.testing.assert_allclose(settled, expected, rtol=1e-6)
    assert np.sign(counts[-1] - counts[0]) == np.sign(speed)


@pytest.mark.parametrize("acceleration", [6000.0, 200.0])
def test_edges_are_timed_each_while_the_speed_changes(acceleration):
    # Evenly faster: a count before the last edge takes what its own mean speed says.
    _, rates, angles = latch(lambda t: 0.5 * acceleration * t**2 + 2e-4, 0.05)
    last = np.floor(angles[8:] / COUNT) * COUNT
    times = np.sqrt((np.stack([last - COUNT, last]) - 2e-4) / (0.5 * acceleration))
    np.testing.assert_allclose(rates[8:], 1.0 / np.diff(times, axis=0)[0], rtol=1e-5)


def test_the_phase_moves_the_edges():
    counts, rates, angles = latch(wobble, 1.0, phase=0.4)
    np.testing.assert_array_equal(counts, np.floor(angles / COUNT + 0.4))
    assert np.any(rates != latch(wobble, 1.0)[1])


def test_a_tenth_of_a_second_without_an_edge_is_standstill():
    counts, rates, _ = latch(lambda t: 2.0 * np.minimum(t, 0.2), 0.5)
    t = np.arange(len(rates)) / RATE
    assert np.all(rates[(t > 0.01) & (t < 0.2)] > 0.9 * 2.0 / COUNT)
    assert np.all(rates[t > 0.302] == 0.0)
    # In between it is no more than the wait since the last edge allows.
    waiting = (t > 0.21) & (t < 0.299)
    assert np.all(rates[waiting] > 0.0)
    assert np.all(rates[waiting] <= 1.0 / (t[waiting] - 0.2))
    assert np.all(np.diff(rates[waiting]) < 0.0)
    assert np.ptp(counts[t > 0.21]) == 0


def test_a_shaft_that_never_moves_has_no_rate():
    counts, rates, _ = latch(lambda t: 0.7 + 0.0 * t, 0.2)
    assert np.all(rates == 0.0)
    assert np.ptp(counts) == 0


def test_dithering_on_an_edge_is_no_motion():
    _, rates, _ = latch(lambda t: 50 * COUNT + 0.3 * COUNT * np.sin(300.0 * t), 0.3)
    assert np.all(rates == 0.0)


def test_the_rate_is_small_after_a_reversal():
    # Turns at t = 0.2, in the middle of a count.
    speed = 1.0
    _, rates, _ = latch(lambda t: 0.5 * COUNT - speed * np.abs(t - 0.2), 0.4)
    t = np.arange(len(rates)) / RATE
    full = speed / COUNT
    np.testing.assert_allclose(rates[(t > 0.01) & (t < 0.19)], full, rtol=1e-6)
    np.testing.assert_allclose(rates[t > 0.21], -full, rtol=1e-6)
    # Never the old direction once the first edge of the new one has passed.
    assert np.all(rates[t > 0.2 + 1.1 / full] <= 0.0)


@pytest.mark.parametrize("cuts", [(1,), (7, 8, 9, 300), tuple(range(1, 799))])
def test_where_a_motion_is_cut_does_not_change_a_bit(cuts):
    whole, pieces = latch(wobble, 1.0, origin=3.7), latch(wobble, 1.0, cuts, origin=3.7)
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_copy_is_independent():
    counter = EncoderCounter(PER_TURN)
    t = np.arange(5 * PER_TICK + 1) * STEP
    angles, further = (moving_at(lambda t: 160.0 * t, t + later) for later in (0.0, t[-1]))
    counter.latch(angles[:-1], angles[-1], 0.0, 0, STEP, PER_TICK)
    copy = EncoderCounter(PER_TURN, memory=counter.memory.copy())
    one = counter.latch(further[:-1], further[-1], 0.0, 5 * PER_TICK, STEP, PER_TICK)
    two = copy.latch(further[:-1], further[-1], 0.0, 5 * PER_TICK, STEP, PER_TICK)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
