"""Loops of the identified actuator in a report: their torque, its band, and where no log was."""

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sim_rig.plots import plots
from sysid import Dataset
from sysid.problem.plots import Evidence

SPEED, CURRENT = 40.0, 0.08  # fast, so that the hysteresis saturates well before the largest speed
PLACES = np.linspace(0.0, 1.0, 400)


def loops(model, parameters, draws, speed_of_braking):
    """Loops from a log that turns fast unbraked, and so fast with the brake on."""
    outputs = np.zeros((800, len(model.outputs)))
    outputs[:400, model.output_names.index("omega")] = SPEED * np.sin(20.0 * PLACES)
    outputs[400:, model.output_names.index("omega")] = speed_of_braking * np.sin(20.0 * PLACES)
    outputs[400:, model.output_names.index("current_brake")] = CURRENT
    record = Dataset(np.zeros((800, len(model.inputs))), outputs, 1e-3)
    (plot,) = plots(model, Evidence(parameters, [record], {}, draws))
    return plot


def sliding(model, p, current, omega):
    """Torque [N*m] of saturated Bouc-Wen hysteresis (Wen 1976) and viscous friction."""
    q = dict(zip(model.parameter_names, p, strict=True))
    z = q["A"] / (q["gamma"] + q["beta"])
    viscous = q["c0"] + q["c1"] * current + q["B_m"] * q["n_c"] ** 2
    return (q["alpha0"] + q["alpha1"] * current) * z + viscous * omega


def drawn(model, n=24):
    """Parameters at a spread of 5 %, (n, n_parameters)."""
    nominal = np.array(model.nominal)
    return nominal * np.exp(0.05 * np.random.default_rng(1).standard_normal((n, len(nominal))))


def test_torque_and_band_are_those_of_the_equations_where_the_brake_slides():
    model = actuator()
    draws = drawn(model)
    plot = loops(model, np.array(model.nominal), draws, SPEED)
    assert "95 %" in plot.caption
    for curve in plot.curves:
        current = float(curve.label.split()[1])
        fastest = int(np.argmax(curve.values["speed"]))
        omega = curve.values["speed"][fastest]
        expected = sliding(model, model.nominal, current, omega)
        assert curve.values["torque"][fastest] == pytest.approx(expected, rel=2e-3)
        spread = 1.96 * np.std([sliding(model, p, current, omega) for p in draws])
        low, high = (end[fastest] for end in curve.band)
        assert high - expected == pytest.approx(spread, rel=2e-2)
        assert expected - low == pytest.approx(spread, rel=2e-2)


def test_functions_of_single_numbers_have_the_same_loops():
    plain, scalar = actuator(), actuator(friction="stribeck")
    names = scalar.parameter_names
    values = dict(zip(plain.parameter_names, plain.nominal, strict=True))
    frictionless = np.array([values.get(name, 0.0) for name in names])
    for scale in ("omega_s", "omega_r"):  # of a friction that is zero
        frictionless[names.index(scale)] = 1.0
    draws = np.array([frictionless, frictionless])
    expected = loops(plain, np.array(plain.nominal), np.empty((0, len(plain.nominal))), SPEED)
    for ours, theirs in zip(
        loops(scalar, frictionless, draws, SPEED).curves, expected.curves, strict=True
    ):
        assert theirs.band is None
        np.testing.assert_allclose(
            ours.values["torque"], theirs.values["torque"], atol=2e-3 * CURRENT
        )


def test_amplifiers_at_their_ends_change_nothing_of_what_the_brake_resists():
    plain, limited = actuator(), actuator(limits=True)
    draws = drawn(plain, 3)
    for ours, theirs in zip(
        loops(limited, np.array(limited.nominal), draws, SPEED).curves,
        loops(plain, np.array(plain.nominal), draws, SPEED).curves,
        strict=True,
    ):
        np.testing.assert_allclose(ours.values["torque"], theirs.values["torque"], atol=1e-6)
        np.testing.assert_allclose(ours.band, theirs.band, atol=1e-6)


@pytest.mark.parametrize(("speed_of_braking", "share"), [(SPEED, 0.0), (0.0, 1.0)])
def test_a_loop_is_beyond_the_logs_where_they_never_braked_at_that_speed(speed_of_braking, share):
    model = actuator()
    none = np.empty((0, len(model.nominal)))
    plot = loops(model, np.array(model.nominal), none, speed_of_braking)
    unbraked, between, braked = plot.curves
    assert np.mean(unbraked.beyond) < 0.1
    assert np.mean(braked.beyond) == pytest.approx(share, abs=0.1)
    assert between.beyond.all(), "no log has such a current"
    assert "%" not in plot.caption
