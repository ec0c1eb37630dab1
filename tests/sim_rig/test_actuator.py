from __future__ import annotations

import numpy as np
import pytest

from sim_rig.actuator import INPUTS, PARAMETERS, STATES, actuator
from sim_rig.plant import actuator_truth
from sysid import BatchSimulator, Dataset, SearchSpace
from sysid.reference import simulate as reference


def thesis_matrix_form(x, u, p, n=1.0):
    """(3.23) with (3.1), (3.3), (3.10), (3.14), (3.15) and (3.22), written as matrices.

    x' = F(x) + G u, the linear part as a matrix over the states; the torque with |i_b|.
    """
    q = dict(zip([parameter.name for parameter in PARAMETERS], p, strict=True))
    omega, z, i_b = x[4], x[5], abs(x[3])
    J = q["n_c"] ** 2 * q["J_m"] + q["J_b"]
    alpha, c = q["alpha0"] + q["alpha1"] * i_b, q["c0"] + q["c1"] * i_b
    F = np.zeros((7, 7))
    F[0, [0, 2]] = -q["omega_dm"], -q["K_dm"] * q["omega_dm"]
    F[1, [1, 3]] = -q["omega_db"], -q["K_db"] * q["omega_db"]
    F[2, [0, 2, 4]] = np.array([1.0, -q["R_m"], q["n_c"] * q["K_m"]]) / q["L_m"]
    F[3, [1, 3]] = np.array([1.0, -q["R_b"]]) / q["L_b"]
    F[4, [2, 4, 5]] = np.array([-q["n_c"] * q["K_m"], -(q["n_c"] ** 2) * q["B_m"] - c, -alpha]) / J
    F[5, [4, 5]] = (
        q["A"] - q["beta"] * abs(z) ** n,
        -q["gamma"] * abs(omega) * abs(z) ** (n - 1.0),
    )
    F[6, 4] = 1.0
    G = np.zeros((7, 3))
    G[0, 0] = q["K_v2i"] * q["K_dm"] * q["omega_dm"]
    G[1, 1] = q["K_v2i"] * q["K_db"] * q["omega_db"]
    G[4, 2] = 1.0 / J
    return F @ x + G @ u


@pytest.mark.parametrize("n", [1.0, 2.0, 1.5])
def test_the_derivative_is_the_equations(n):
    rng = np.random.default_rng(1)
    model = actuator(n)
    for _ in range(200):
        x = rng.normal(size=7) * [10, 10, 2, 0.2, 20, 1, 3]
        u = rng.normal(size=3) * [3, 0.4, 0.5]
        p = model.nominal * np.exp(rng.normal(size=len(PARAMETERS)))
        p[-1] = rng.choice([-1.0, 2.0, -3.5])
        expected = thesis_matrix_form(x, u, p, n)
        found = np.array(model.derivative(tuple(x), tuple(u), tuple(p)))
        # Terms cancel: compare relative to what they are made of.
        size = thesis_size(x, u, p, n)
        assert np.all(np.abs(found - expected) <= 1e-12 * size)


def thesis_size(x, u, p, n):
    """Magnitude of the terms of each equation: the same with all signs positive, roughly."""
    basis = [thesis_matrix_form(np.where(np.arange(7) == i, x, 0.0), 0 * u, p, n) for i in range(7)]
    forced = thesis_matrix_form(0 * x, u, p, n)
    whole = thesis_matrix_form(x, 0 * u, p, n)
    return np.sum(np.abs(basis), axis=0) + np.abs(forced) + np.abs(whole) + 1e-9


def excitation(n=160, dt=1.0 / 800.0):
    rng = np.random.default_rng(2)
    inputs = np.column_stack(
        [
            np.repeat(rng.uniform(-4, 4, n // 8), 8),
            np.repeat(rng.choice([0.0, 0.38], n // 16), 16),
            0.1 * np.sin(np.arange(n) / 10.0),
        ]
    )
    return Dataset(inputs, np.full((n, 3), np.nan), dt)


def outputs(changes, exponent=1.0, n_steps=32):
    """Outputs with some parameters multiplied or set; the steps are given, so that they agree."""
    model = actuator(exponent)
    vector = model.vector(actuator_truth() | changes)
    return BatchSimulator(model).trajectories(vector, excitation(), n_steps)[0]


def scaled(factors):
    truth = actuator_truth()
    return {name: truth[name] * factor for name, factor in factors.items()}


REDUNDANCIES = {
    # z -> 2z: homogeneous of degree one for n = 1; else |z|^n takes 2^(1-n).
    "z": (1.0, {"A": 2.0, "alpha0": 0.5, "alpha1": 0.5}, {"z": 2.0}),
    "z, n=2": (
        2.0,
        {"A": 2.0, "alpha0": 0.5, "alpha1": 0.5, "beta": 0.5, "gamma": 0.5},
        {"z": 2.0},
    ),
    # The coil's voltage in other units: only ratios of it act.
    "coil up": (1.0, {"R_b": 4.0, "L_b": 4.0, "K_db": 4.0}, {"voltage_brake": 4.0}),
    "coil down": (1.0, {"R_b": 0.5, "L_b": 0.5, "K_db": 0.5}, {"voltage_brake": 0.5}),
}


@pytest.mark.parametrize("case", REDUNDANCIES)
def test_redundant_parameters_are_another_unit_of_a_hidden_state(case):
    """To the bit, the factors being powers of two."""
    exponent, factors, units = REDUNDANCIES[case]
    model, rng = actuator(exponent), np.random.default_rng(3)
    unit = np.array([units.get(name, 1.0) for name in model.state_names])
    p = model.vector(actuator_truth())
    q = model.vector(actuator_truth() | scaled(factors))
    for _ in range(50):
        x = rng.normal(size=7) * [10, 10, 2, 0.2, 20, 1, 3]
        u = rng.normal(size=3) * [3, 0.4, 0.5]
        one = np.array(model.derivative(tuple(x), tuple(u), tuple(p)))
        other = np.array(model.derivative(tuple(unit * x), tuple(u), tuple(q)))
        np.testing.assert_array_equal(unit * one, other)


@pytest.mark.parametrize("case", REDUNDANCIES)
def test_redundant_parameters_leave_the_outputs_unchanged(case):
    exponent, factors, _units = REDUNDANCIES[case]
    one, other = outputs(scaled(factors), exponent), outputs({}, exponent)
    np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize(
    "changes",
    [
        {"A": 2.0},
        {"A": 2.0, "alpha0": 0.5},
        {"R_b": 4.0, "L_b": 4.0},
        {"J_m": 1.1},
        {"c0": 1.5, "B_m": 1.5},
    ],
)
def test_half_a_redundancy_does_change_them(changes):
    assert np.max(np.abs(outputs(scaled(changes)) - outputs({}))) > 1e-4


def test_only_the_sum_of_the_inertias_acts():
    unit = 2.0**-16
    one = outputs({"J_m": 5 * unit, "J_b": 1 * unit})
    geared = {"n_c": -2.0, "J_m": 1.25 * unit, "J_b": unit} | scaled({"K_m": 0.5, "B_m": 0.25})
    for changes in ({"J_m": 1 * unit, "J_b": 5 * unit}, geared):
        np.testing.assert_allclose(outputs(changes), one, atol=1e-9 * np.abs(one).max())


def test_only_the_sum_of_the_viscous_dampings_acts():
    one = outputs({"B_m": 1e-4, "c0": 3e-4})
    other = outputs({"B_m": 3e-4, "c0": 1e-4})
    np.testing.assert_allclose(one, other, atol=1e-10 * np.abs(one).max())
    assert np.max(np.abs(one - outputs({"B_m": 1e-4, "c0": 4e-4}))) > 1e-3


def test_coil_and_driver_may_swap_their_time_constants():
    """From command to current they are omega K/L over s^2 + (R/L + omega) s + omega (R + K)/L."""
    p = actuator_truth()
    gain, cutoff, R, L = (p[name] for name in ("K_db", "omega_db", "R_b", "L_b"))
    swapped = {"omega_db": R / L, "R_b": cutoff * L, "K_db": gain * cutoff * L / R}
    model = actuator()
    found = [
        reference(model, model.vector(p | changes), excitation(48)) for changes in ({}, swapped)
    ]
    scale = np.abs(found[0]).max(axis=0)
    np.testing.assert_allclose(found[0] / scale, found[1] / scale, atol=1e-6)


def test_truth_lies_in_the_ranges_and_is_feasible():
    model = actuator()
    space = SearchSpace.of(model)
    truth = model.vector(actuator_truth())[list(space.index)]
    assert np.all((truth > space.lower) & (truth < space.upper))
    assert np.all(space.violations(truth[None]) == 0.0)
    assert set(actuator_truth()) == set(model.parameter_names)


def test_class_1_is_demanded():
    model = actuator()
    space = SearchSpace.of(model)
    row = model.vector({"gamma": 10.0, "beta": 12.0})[list(space.index)]
    assert space.violations(row[None]).sum() == pytest.approx(2.0)


def test_inputs_are_held_as_they_are_made():
    assert [signal.hold for signal in INPUTS] == ["zoh", "zoh", "foh"]
    assert len(STATES) == 7
