"""Which changes of the parameters no output can show, and which only look alike.

A redundancy is another unit for a hidden state: with the states in the new unit the equations
are the same, to the bit where the factors are powers of two.
"""

from __future__ import annotations

import functools
import math
import random
from typing import NamedTuple

import numpy as np
import pytest

from tests.sim_rig.support import Parts, constant, follow, random_point
from tests.soak import mostly_soak
from tests.sysid.support import outputs_of

FREE_TORQUES = (
    "K_dm", "G_dm", "R_m", "L_m", "K_m", "J_m", "B_m", "J_b", "alpha0", "alpha1", "c0", "c1",
    "epsilon0", "epsilon1", "F_c", "F_s", "B_f", "F_cos", "F_sin",
)  # fmt: skip


class Redundancy(NamedTuple):
    """Factors of parameters and of hidden states; outputs that do not show it, default all."""

    parts: Parts
    factors: dict
    units: dict
    outputs: tuple = ()


def bent(n, smooth, s):
    """z -> s z: of |z|^n the shape takes s^(1-n), and the smooth sign of z its sharpness."""
    shape = {} if n == 1.0 else {"beta": s ** (1.0 - n), "gamma": s ** (1.0 - n)}
    sharpness = {"rho": 1.0 / s} if smooth else {}
    factors = {"A": s, "alpha0": 1.0 / s, "alpha1": 1.0 / s} | shape | sharpness
    return Redundancy(Parts(exponent=n, smooth=smooth, load="pulley"), factors, {"z": s})


REDUNDANCIES = {
    **{
        f"bristle n={n:g}{' smooth' * smooth}": bent(n, smooth, 4.0)
        for n in (1.0, 2.0, 1.5)
        for smooth in (False, True)
    },
    # The coil's voltage in other units: only ratios of it act.
    "coil, closed loop": Redundancy(
        Parts(hysteresis="lugre", load="hand"),
        {"R_b": 4.0, "L_b": 4.0, "K_db": 4.0},
        {"voltage_brake": 4.0},
    ),
    "coil, open loop": Redundancy(
        Parts(driver_brake="open", hysteresis="dahl", sensor="between", load="free"),
        {"R_b": 0.5, "L_b": 0.5, "G_db": 0.5},
        {"voltage_brake": 0.5},
    ),
    # A brake current that nobody measures has no unit of its own.
    "brake current not measured, open loop": Redundancy(
        Parts(driver_brake="open", hysteresis="lugre"),
        {"R_b": 0.5, "L_b": 0.5, "alpha1": 0.5, "c1": 0.5, "epsilon1": 0.5},
        {"current_brake": 2.0},
        ("current_motor", "omega"),
    ),
    # Without a known torque all torques, and the motor's volts with them, have no unit either.
    "all torques, free shaft": Redundancy(
        Parts("closed", "closed", "lugre", friction="cyclic", load="free"),
        dict.fromkeys(FREE_TORQUES, 2.0),
        {"voltage_motor": 2.0},
    ),
    "all torques, free shaft, open loop": Redundancy(
        Parts("open", "open", "dahl", smooth=True, friction="cyclic", load="free"),
        dict.fromkeys(FREE_TORQUES, 4.0),
        {"voltage_motor": 4.0},
    ),
}


@pytest.mark.parametrize("case", REDUNDANCIES)
def test_redundant_parameters_are_another_unit_of_a_hidden_state(case):
    parts, factors, units, outputs = REDUNDANCIES[case]
    model, rng = parts.build(outputs=outputs), random.Random(3)
    unit = np.array([units.get(name, 1.0) for name in model.state_names])
    assert not set(units) & set(model.output_names)
    # 4^1.5 is a power of two, but pow() rounds its last digit as it likes.
    rounding = 1e-13 if parts.exponent == 1.5 else 0.0
    for _ in range(50):
        x, u, p = random_point(model, rng).of(model)
        q = tuple(v * factors.get(k, 1.0) for k, v in zip(model.parameter_names, p, strict=True))
        in_units = tuple((unit * x).tolist())
        one = unit * model.derivative(x, u, p)
        other = np.array(model.derivative(in_units, u, q))
        np.testing.assert_allclose(other, one, rtol=rounding)
        same = outputs_of(model, x, u, p)
        np.testing.assert_allclose(outputs_of(model, in_units, u, q), same, rtol=rounding)


def response(parts, factors, outputs=(), changes=None):
    """Outputs of an excited model from rest, in parts of their largest."""
    model = parts.build(outputs=outputs, parameters="rig")
    p = dict(zip(model.parameter_names, model.nominal, strict=True)) | (changes or {})
    p |= {name: p[name] * factor for name, factor in factors.items() if name in p}
    pushes = constant(model)(0.0)[2:]

    def inputs(t):
        motor = 1.5 * math.sin(60.0 * t) + 1.0 * math.sin(170.0 * t)
        brake = 0.06 * (1.0 - math.cos(90.0 * t))
        more = (0.05 * math.sin(80.0 * t), *pushes[1:]) if pushes else ()
        return (motor, brake, *more)

    times = np.linspace(0.0, 0.08, 60)
    found = follow(model, inputs, times[-1], p, times=times, rtol=1e-8, atol=1e-10)
    rows = range(len(times))
    return np.array([[found.output(name, row) for row in rows] for name in model.output_names])


@functools.cache
def unchanged(parts):
    return response(parts, {})


def distance(one, other):
    return np.max(np.abs(one - other) / np.abs(one).max(axis=1, keepdims=True))


MEASURED = Parts(load="measured")
OPEN_FREE = Parts("open", "open", "dahl", friction="cyclic", load="free", sensor="between")


@pytest.mark.parametrize(
    ("parts", "factors"),
    [
        (MEASURED, {"A": 2.0}),
        (MEASURED, {"A": 2.0, "alpha0": 0.5}),
        (MEASURED, {"A": 2.0, "alpha0": 0.5, "alpha1": 0.5, "beta": 0.5, "gamma": 0.5}),
        (Parts(exponent=2.0), {"A": 2.0, "alpha0": 0.5, "alpha1": 0.5}),
        (MEASURED, {"R_b": 4.0, "L_b": 4.0}),
        (MEASURED, {"R_m": 2.0, "L_m": 2.0, "K_dm": 2.0}),
        (MEASURED, {"J_m": 1.1}),
        (MEASURED, {"c0": 8.0, "B_m": 8.0}),
        # The measured torque gives all torques their unit, and so does a sensor between.
        (MEASURED, dict.fromkeys(FREE_TORQUES, 2.0)),
        (OPEN_FREE, dict.fromkeys(FREE_TORQUES, 2.0)),
        # A measured brake current has its unit.
        (Parts(driver_brake="open"), {"R_b": 0.5, "L_b": 0.5, "alpha1": 0.5, "c1": 0.5}),
        # Dahl slides at z = 1 and LuGre's z is the shaft's own angle: neither z has another unit.
        (Parts(hysteresis="dahl"), {"alpha0": 0.5, "alpha1": 0.5}),
        (Parts(hysteresis="dahl"), {"sigma": 2.0}),
        (Parts(hysteresis="dahl"), {"sigma": 2.0, "alpha0": 0.5, "alpha1": 0.5}),
        (Parts(hysteresis="lugre"), {"zeta": 0.5, "alpha0": 0.5, "alpha1": 0.5}),
        (
            Parts(hysteresis="lugre"),
            {"zeta": 0.5, "alpha0": 0.5, "alpha1": 0.5, "epsilon0": 0.5, "epsilon1": 0.5},
        ),
        (Parts(hysteresis="lugre"), {"zeta": 2.0, "alpha0": 2.0, "alpha1": 2.0}),
    ],
)
def test_half_a_redundancy_or_another_models_changes_the_outputs(parts, factors):
    assert distance(unchanged(parts), response(parts, factors)) > 1e-3


@pytest.mark.parametrize("kind", ["bouc-wen", "dahl", "lugre"])
def test_only_the_sum_of_the_inertias_acts(kind):
    unit = 2.0**-16
    parts = Parts(hysteresis=kind, friction="stribeck")
    model, rng = parts.build(), random.Random(4)
    for _ in range(20):
        point = random_point(model, rng)
        slopes = [
            model.derivative(*point._replace(q=point.q | inertias | {"n_c": -2.0}).of(model))
            for inertias in (
                {"J_m": 1.25 * unit, "J_b": unit},
                {"J_m": 0.5 * unit, "J_b": 4.0 * unit},
            )
        ]
        assert slopes[0] == slopes[1]


@pytest.mark.parametrize("kind", ["bouc-wen", "dahl", "lugre"])
def test_only_the_sum_of_the_viscous_dampings_acts(kind):
    """n_c^2 B_m, c0 and the brushes' B_f."""
    parts = Parts(hysteresis=kind, friction="stribeck")
    model, rng = parts.build(), random.Random(5)
    for _ in range(20):
        point = random_point(model, rng)
        slopes = [
            model.derivative(*point._replace(q=point.q | dampings | {"n_c": -2.0}).of(model))
            for dampings in (
                {"B_m": 1e-4, "c0": 5e-4, "B_f": 0.0},
                {"B_m": 5e-5, "c0": 4e-4, "B_f": 3e-4},
            )
        ]
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-9)


@pytest.mark.parametrize("kind", ["closed", "open"])
def test_coil_and_driver_may_swap_their_time_constants(kind):
    """Current over command is g / (s^2 + (R/L + omega) s + ...): symmetric in the two rates."""
    parts = Parts(driver_brake=kind)
    model = parts.build(parameters="rig")
    gain = "K_db" if kind == "closed" else "G_db"
    K, cutoff, R, L = (model.parameter(name).nominal for name in (gain, "omega_db", "R_b", "L_b"))
    swapped = {"omega_db": R / L, "R_b": cutoff * L, gain: K * cutoff * L / R}
    one, other = unchanged(parts), response(parts, {}, changes=swapped)
    assert distance(one, other) < 1e-6
    half = {"omega_db": R / L, "R_b": cutoff * L}
    assert distance(one, response(parts, {}, changes=half)) > 1e-3


@pytest.mark.parametrize(
    ("kind", "directions"), mostly_soak([("bouc-wen", 4), ("dahl", 3), ("lugre", 3)])
)
def test_there_are_no_more_redundancies_than_these(kind, directions):
    """Rank of the outputs' sensitivities: coil, inertias, dampings, and the bristle's unit."""
    model = Parts(hysteresis=kind).build()
    free = [i for i, parameter in enumerate(model.parameters) if not parameter.fixed]
    step = 1e-6  # few samples of so small a change cross a kink
    factors = np.ones((2 * len(free), len(model.parameters)))
    for row, i in enumerate(free):
        factors[2 * row, i], factors[2 * row + 1, i] = math.exp(step), math.exp(-step)
    outputs = population_outputs(model, factors * model.nominal)
    slopes = (outputs[0::2] - outputs[1::2]) / (2.0 * step)
    slopes /= np.abs(outputs).max(axis=(0, 1))
    sizes = np.linalg.svd(slopes.reshape(len(free), -1), compute_uv=False)
    sizes /= sizes[0]
    assert np.all(sizes[-directions:] < 1e-8)
    assert sizes[-directions - 1] > 1e-5


def population_outputs(model, parameters):
    """Classical Runge-Kutta on a whole population, (n, samples, outputs).

    The exact forms use nothing but arithmetic and abs: they take arrays.
    """
    dt, p = 4e-5, tuple(parameters.T)
    x = np.zeros((len(model.states), len(parameters)))

    def slope(t, x):
        u = (
            2.0 * math.sin(60.0 * t) + 1.5 * math.sin(170.0 * t),
            0.08 * (1.0 - math.cos(90.0 * t)),
            0.05 * math.sin(80.0 * t),
        )
        return np.array(model.derivative(tuple(x), u, p))

    rows = []
    for k in range(2000):
        t = k * dt
        if k % 20 == 0:
            rows.append(x[[2, 3, 4]].T)
        a = slope(t, x)
        b = slope(t + dt / 2, x + dt / 2 * a)
        c = slope(t + dt / 2, x + dt / 2 * b)
        d = slope(t + dt, x + dt * c)
        x = x + dt / 6 * (a + 2 * b + 2 * c + d)
    return np.stack(rows, axis=1)
