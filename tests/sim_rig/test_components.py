from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from sim_rig.components import bouc_wen_rate, brake_torque, closed_loop_driver, winding

numbers = st.floats(-50.0, 50.0)


@given(numbers, numbers, st.floats(0.1, 100.0), st.floats(-100.0, 100.0), st.floats(0.1, 100.0))
@pytest.mark.parametrize("n", [1.0, 2.0, 1.5, 3.0])
def test_bouc_wen_is_its_equation(n, omega, z, gamma, beta, A):
    # (3.14), term by term.
    expected = (
        -gamma * abs(omega) * z * math.pow(abs(z), n - 1.0)
        - beta * omega * math.pow(abs(z), n)
        + A * omega
    )
    scale = abs(A * omega) + (gamma + abs(beta)) * abs(omega) * abs(z) ** n
    found = bouc_wen_rate(n)(omega, z, gamma, beta, A)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-12 * scale + 1e-300)


@pytest.mark.parametrize("n", [1.0, 2.0, 1.5])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_sliding_ends_at_the_yield_point_in_both_directions(n, direction):
    gamma, beta, A = 28.0, 20.0, 60.0
    rate = bouc_wen_rate(n)
    z0 = (A / (beta + gamma)) ** (1.0 / n)
    assert rate(direction * 3.0, direction * z0, gamma, beta, A) == pytest.approx(0.0, abs=1e-9)
    end = solve_ivp(
        lambda t, z: [rate(direction * 3.0, z[0], gamma, beta, A)], (0, 1), [0.0], rtol=1e-10
    ).y[0, -1]
    assert end == pytest.approx(direction * z0, rel=1e-6)


@pytest.mark.parametrize("n", [1.0, 2.0, 1.5])
def test_hysteresis_does_not_depend_on_the_rate(n):
    """dz/dtheta depends on the direction alone: twice the speed, twice the rate."""
    rate = bouc_wen_rate(n)
    for z in (-1.0, -0.3, 0.4, 1.1):
        for omega in (-2.0, 0.7):
            assert rate(2.0 * omega, z, 28.0, 20.0, 60.0) == pytest.approx(
                2.0 * rate(omega, z, 28.0, 20.0, 60.0)
            )


def motions(seed, count=6):
    """Random smooth speeds: a few sines."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        a, f, phase = rng.normal(0, 4, 5), rng.uniform(0.2, 8.0, 5), rng.uniform(0, 6.3, 5)
        yield lambda t, a=a, f=f, phase=phase: float(np.sum(a * np.sin(2 * np.pi * f * t + phase)))


@pytest.mark.parametrize("n", [1.0, 2.0, 1.5])
def test_the_brake_is_passive_and_z_stays_bounded(n):
    """With constant current the work done on the brake is never less than what it stores.

    From (3.14), A omega z = z dz/dt + gamma |omega| |z|^(n+1) + beta omega z |z|^n, whose last
    two terms are not negative for gamma >= |beta|. So alpha z^2 / (2 A) is a storage function.
    """
    rate, (gamma, A) = bouc_wen_rate(n), (28.0, 60.0)
    alpha0, alpha1, c0, c1 = 0.0112, 2.8, 1.2e-4, 6e-4
    for number, speed in enumerate(motions(1)):
        current = [0.0, 0.05, 0.19][number % 3]
        beta = [20.0, -20.0, 28.0][number % 3]
        start = [0.0, 0.5, -1.0][number % 3]

        def rhs(t, x, speed=speed, current=current, beta=beta):
            omega = speed(t)
            torque = brake_torque(current, omega, x[0], alpha0, alpha1, c0, c1)
            return [rate(omega, x[0], gamma, beta, A), torque * omega]

        found = solve_ivp(rhs, (0.0, 1.5), [start, 0.0], rtol=1e-8, atol=1e-11, max_step=0.01)
        z, work = found.y
        stored = (alpha0 + alpha1 * current) * z**2 / (2.0 * A)
        lost = work - (stored - stored[0])
        assert np.all(np.diff(lost) >= -1e-9)
        assert lost[-1] > 1e-4
        z_max = max(abs(start), (A / (beta + gamma)) ** (1.0 / n))
        assert np.all(np.abs(z) <= z_max * (1.0 + 1e-6))
        assert np.ptp(z) > 0.1


def test_an_undershoot_of_the_current_brakes_as_much_as_an_overshoot():
    positive = brake_torque(0.05, 2.0, 1.0, 0.01, 3.0, 1e-4, 1e-3)
    assert brake_torque(-0.05, 2.0, 1.0, 0.01, 3.0, 1e-4, 1e-3) == positive
    assert positive == pytest.approx((0.01 + 3.0 * 0.05) * 1.0 + (1e-4 + 1e-3 * 0.05) * 2.0)


def test_driver_and_winding_by_hand():
    # 100 (50 (0.5*2 - 0.4) - 7) and (7 - 3*0.4 - 0.8)/0.02.
    assert closed_loop_driver(7.0, 0.4, 2.0, 50.0, 100.0, 0.5) == pytest.approx(2300.0)
    assert winding(0.4, 7.0, 0.8, 3.0, 0.02) == pytest.approx(250.0)
