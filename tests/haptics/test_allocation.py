"""Sharing a torque, against a minimiser that knows only the costs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from haptics import laws
from haptics.allocation import Allocation

R = (1.18, 126.0)
HEATING = Allocation("heating", 0.14, R, (2.0, 0.18))
STICTION = Allocation("stiction", 0.14, R, (2.0, 0.18))

TORQUES = st.floats(-0.8, 0.8)
SLOPES = st.floats(-3.6, 3.6)


def brake(allocation, torque, slope):
    return laws.brake_current(torque, slope, allocation.constants)


def heat(torque, slope, i_b):
    i_m = (torque - slope * i_b) / 0.14
    return R[0] * i_m**2 + R[1] * i_b**2


@given(TORQUES, SLOPES)
def test_currents_heat_as_little_as_any_that_give_the_torque(torque, slope):
    i_b = brake(HEATING, torque, slope)
    best = minimize_scalar(lambda i: heat(torque, slope, i), bounds=(0.0, 0.18), method="bounded").x
    i_m = (torque - slope * i_b) / 0.14
    if abs((torque - slope * best) / 0.14) <= 2.0:  # else the motor's limit decides
        assert heat(torque, slope, i_b) <= heat(torque, slope, best) * (1.0 + 1e-6) + 1e-9
    elif torque * slope > 0.0 and abs(slope) > 0.5:
        assert abs(i_m) <= 2.0 + 1e-9 or i_b == pytest.approx(0.18)


@given(TORQUES, SLOPES, st.sampled_from([HEATING, STICTION]))
def test_the_brake_is_never_asked_for_work(torque, slope, allocation):
    i_b = brake(allocation, torque, slope)
    assert 0.0 <= i_b <= 0.18
    assert i_b == 0.0 or torque * slope > 0.0


@given(TORQUES, st.sampled_from([HEATING, STICTION]))
def test_nothing_jumps_where_the_motion_turns_round(torque, allocation):
    slopes = np.linspace(-0.2, 0.2, 2001)
    currents = [brake(allocation, torque, slope) for slope in slopes.tolist()]
    torques = np.abs(slopes * currents)
    assert np.abs(np.diff(currents)).max() < 0.01  # A, from one thousandth of the range to the next
    assert torques[1000] == 0.0 and np.abs(np.diff(torques)).max() < 2e-3


def test_without_heat_to_save_the_brake_gives_only_what_the_motor_cannot():
    assert brake(STICTION, -0.27, -3.5) == 0.0
    assert brake(STICTION, -0.35, -3.5) == pytest.approx((0.35 - 0.28) / 3.5)
    assert brake(Allocation("motor", 0.14, R, (2.0, 0.18)), -0.5, -3.5) == 0.0
