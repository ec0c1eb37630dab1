"""Amplifiers and windings against transfer functions, and where the amplifiers end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from sim_rig.actuator import actuator
from sim_rig.physics.electrical import (
    MAX_CURRENT,
    SUPPLY,
    amplifier,
    closed_loop_drive,
    drive,
    excess,
    limited_winding,
    open_loop_drive,
    saturate,
    winding,
)
from tests.sim_rig.support import AMPLIFIER, Parts, constant, follow

volts, amperes = st.floats(-60.0, 60.0), st.floats(-6.0, 6.0)
GAIN = 0.5  # A/V


def test_drivers_and_winding_by_hand():
    # 100 (50 (0.5*2 - 0.4) - 7), 100 (3*2 - 7) and (7 - 3*0.4 - 0.8)/0.02.
    closed, opened = closed_loop_drive(0.4, 2.0, 0.5, 50.0), open_loop_drive(0.4, 2.0, 0.5, 3.0)
    assert amplifier((7.0,), closed, (100.0,)) == pytest.approx((2300.0,))
    assert amplifier((7.0,), opened, (100.0,)) == pytest.approx((-100.0,))
    assert winding(0.4, 7.0, 0.8, 3.0, 0.02) == pytest.approx(250.0)


def from_command_to_current(kind, q, k):
    """Numerator and denominator from (3.6) or (3.8) to (3.9) and the winding's 1/(L s + R).

    With the lag 1 + s/w1 + s^2/(w1 w2) + ... of an amplifier of higher order, and its output
    resistance in series with the winding's.
    """
    R, L = q[f"R_{k}"] + q.get(f"R_o{k}", 0.0), q[f"L_{k}"]
    cutoffs = [q[f"omega_d{k}{n}"] for n in ("", "2", "3") if f"omega_d{k}{n}" in q]
    lag = [1.0 / np.prod(cutoffs[:n]) for n in range(len(cutoffs), -1, -1)]
    if kind == "closed":
        K = q[f"K_d{k}"]
        return [K * q["K_v2i"]], np.polyadd(np.polymul(lag, [L, R]), [K])
    return [q[f"G_d{k}"]], np.polymul(lag, [L, R])


@pytest.mark.parametrize(
    ("motor", "brake"), [("closed", "closed"), ("open", "closed"), ("closed", "open")]
)
@pytest.mark.parametrize(
    "amplifier", [(1, 1, False, False), (2, 3, True, False), (3, 2, True, True)]
)
def test_a_step_of_the_command_gives_the_transfer_functions_step_response(motor, brake, amplifier):
    amplifiers = dict(zip(AMPLIFIER, amplifier, strict=True))
    parts = Parts(driver_motor=motor, driver_brake=brake, load="locked", **amplifiers)
    model = parts.build(parameters="rig")
    q = dict(zip(model.parameter_names, model.nominal, strict=True))
    steps = {"motor": 1.5, "brake": 0.2}
    inputs = constant(model, **{f"applied_voltage_{k}": v for k, v in steps.items()})
    times = np.linspace(0.0, 0.02, 401)
    found = follow(model, inputs, 0.02, rtol=1e-9, times=times)
    for channel, kind in (("motor", motor), ("brake", brake)):
        system = signal.lti(*from_command_to_current(kind, q, channel[0]))
        expected = steps[channel] * signal.step(system, T=times)[1]
        np.testing.assert_allclose(
            found[f"current_{channel}"], expected, atol=1e-6 * np.abs(expected).max()
        )


@given(value=volts, limit=st.floats(0.1, 30.0))
def test_a_value_is_what_is_kept_of_it_and_its_excess(value, limit):
    kept = saturate(value, limit)
    assert abs(kept) <= limit
    assert kept == (value if abs(value) <= limit else math.copysign(limit, value))
    assert kept + excess(value, limit) == pytest.approx(value, rel=1e-12)
    assert excess(value, limit) * value >= 0.0


@given(
    voltage=st.floats(-SUPPLY, SUPPLY),
    current=st.floats(-MAX_CURRENT, MAX_CURRENT),
    command=st.floats(-MAX_CURRENT / GAIN, MAX_CURRENT / GAIN),
)
@pytest.mark.parametrize("kind", ["closed", "open"])
def test_within_its_range_a_limited_amplifier_is_the_plain_one(kind, voltage, current, command):
    plain, limited = (drive(kind, limits)(current, command, GAIN, 7.0) for limits in (0, 1))
    assert limited == pytest.approx(plain, rel=1e-12, abs=1e-9)
    assert limited_winding(current, voltage, 0.3, 2.0, 0.01) == winding(
        current, voltage, 0.3, 2.0, 0.01
    )


@given(voltage=volts, current=amperes, command=st.floats(-12.0, 12.0))
def test_beyond_its_range_it_gives_way(voltage, current, command):
    at_end = math.copysign(min(abs(command), MAX_CURRENT / GAIN), command)
    closed, opened = drive("closed", True), drive("open", True)
    assert closed(current, command, GAIN, 7.0) == pytest.approx(
        closed_loop_drive(current, at_end, GAIN, 7.0), rel=1e-12, abs=1e-9
    )
    less = open_loop_drive(current, command, GAIN, 7.0) - opened(current, command, GAIN, 7.0)
    # 100 V for each ampere beyond the limit, against the current.
    beyond = max(abs(current) - MAX_CURRENT, 0.0)
    assert less == pytest.approx(math.copysign(100.0 * beyond, current), abs=1e-6)
    across = math.copysign(min(abs(voltage), SUPPLY), voltage)
    assert limited_winding(current, voltage, 0.3, 2.0, 0.01) == pytest.approx(
        winding(current, across, 0.3, 2.0, 0.01)
    )


# --- in the actuator ------------------------------------------------------------------------


def locked(driver_motor="closed", driver_brake="closed"):
    """A motor that cannot turn has no back-EMF."""
    parts = Parts(driver_motor, driver_brake, load="locked", limits=True)
    return parts.build(parameters="rig")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_closed_loop_asks_for_no_more_than_the_rated_current(sign):
    model = locked()
    far, at_limit = (
        follow(model, constant(model, applied_voltage_motor=sign * command), 0.02)
        for command in (50.0, MAX_CURRENT / GAIN)
    )
    np.testing.assert_array_equal(far.y, at_limit.y)
    # 0.99 of the 0.5 A/V remain at rest.
    assert abs(far["current_motor"][-1]) == pytest.approx(MAX_CURRENT, rel=0.011)
    # Its loop rings: a step passes the limit for a moment, as in the thesis's figure 4.3.
    peak = np.abs(far["current_motor"]).max()
    assert MAX_CURRENT < peak < 2.0 * MAX_CURRENT


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("command", [5.5, 10.0])
def test_an_open_loop_keeps_to_the_rated_current_within_a_part_of_its_foldback(sign, command):
    """At rest R i = G u - 100 (i - 2.5): for any command of the converters 1.2 % beyond."""
    model = locked(driver_motor="open")
    found = follow(model, constant(model, applied_voltage_motor=sign * command), 0.02)
    G, R = (model.parameter(name).nominal for name in ("G_dm", "R_m"))
    expected = (G * command + 100.0 * MAX_CURRENT) / (R + 100.0)
    assert sign * found["current_motor"][-1] == pytest.approx(expected, rel=1e-4)
    assert MAX_CURRENT < expected < 1.012 * MAX_CURRENT
    assert np.abs(found["current_motor"]).max() < 1.7 * MAX_CURRENT


@pytest.mark.parametrize("speed", [50.0, -150.0])
def test_a_motor_turned_by_hand_drives_no_more_than_its_foldback_through_an_open_loop(speed):
    """Short-circuited it would drive 6 A and 18 A: the amplifier holds against it, by 100 V/A."""
    model = Parts("open", load="hand", limits=True).build(parameters="rig")
    inputs = constant(model, hand_grip=1.0, hand_omega=speed)
    found = follow(model, inputs, 0.05, {"K_u": 0.0, "B_u": 1e3}, {"omega": speed})
    K, R = (model.parameter(name).nominal for name in ("K_m", "R_m"))
    current = found["current_motor"][-1]
    expected = (K * abs(speed) + 100.0 * MAX_CURRENT) / (R + 100.0)
    assert current == pytest.approx(-math.copysign(expected, speed), rel=1e-3)
    assert expected < 1.1 * MAX_CURRENT < K * abs(speed) / R


@pytest.mark.parametrize("kind", ["closed", "open"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_winding_sees_more_than_the_supply(kind, sign):
    """A coil that would need 40 V for what is asked of it gets 24 V."""
    model = locked(driver_brake=kind)
    resistance = 40.0 / 0.19
    inputs = constant(model, applied_voltage_brake=sign * 2.0)
    found = follow(model, inputs, 0.05, {"R_b": resistance})
    current = sign * found["current_brake"]
    assert current[-1] == pytest.approx(SUPPLY / resistance, rel=1e-4)
    assert sign * found["voltage_brake"][-1] > SUPPLY
    slope = np.diff(current) / np.diff(found.t)
    assert slope.max() <= SUPPLY / model.parameter("L_b").nominal * 1.001


def test_a_free_motor_runs_up_to_the_back_emf_of_the_supply_and_no_further():
    model = Parts(load="free", limits=True).build(parameters="rig")
    inputs = constant(model, applied_voltage_motor=5.0)
    quiet = {"alpha0": 0.0, "alpha1": 0.0, "c0": 0.0, "B_m": 0.0}
    speed = follow(model, inputs, 1.0, quiet)["omega"]
    top = SUPPLY / model.parameter("K_m").nominal
    assert 0.99 * top < speed.max() < top * (1.0 + 1e-6)


@pytest.mark.parametrize("row", ["A", "B", "C", "D"])
def test_the_default_ranges_hold_every_row_of_table_4_1(row):
    # As printed there: K_cmd_m, omega_cmd_m [rad/s], R_m [ohm], L_m [mH], K_m [N m/A].
    table = {
        "A": (10.0, 400.0, 1.18, 4.80, 0.141),
        "B": (29.6, 1046.0, 3.44, 0.912, 0.373),
        "C": (112.0, 1828.0, 6.61, 1.18, 0.0597),
        "D": (379.0, 4517.0, 0.255, 0.768, 0.0985),
    }
    model = actuator()
    for name, value in zip(("K_dm", "omega_dm", "R_m", "L_m", "K_m"), table[row], strict=True):
        parameter = model.parameter(name)
        si = 1e-3 * value if name == "L_m" else value
        assert 1.05 * parameter.lower < si < parameter.upper / 1.05
