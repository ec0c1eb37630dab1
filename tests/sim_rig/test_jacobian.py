"""Linear models of the actuator: finite differences, the thesis's matrices, operating points."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid import ModelError, equilibrium, linearize
from tests.sim_rig.support import ALL, HYSTERESES, Parts, random_point
from tests.sysid.support import outputs_of

# --- finite differences ---------------------------------------------------------------------


def differences(function, point, steps):
    """Central differences with Richardson's extrapolation, and the error that rounding leaves.

    Returns (derivatives, rounding), each (m, n).
    """
    derivatives, rounding = [], []
    for i, step in enumerate(steps):
        halves = []
        for h in (step, step / 2.0):
            ahead, back = list(point), list(point)
            ahead[i] += h
            back[i] -= h
            up, down = (np.array(function(tuple(v))) for v in (ahead, back))
            halves.append((up - down) / (ahead[i] - back[i]))
        derivatives.append((4.0 * halves[1] - halves[0]) / 3.0)
        rounding.append((np.abs(up) + np.abs(down)) * 1e-15 / step)
    return np.stack(derivatives, axis=1), np.stack(rounding, axis=1)


# Small against how the equations bend there: tanh(rho omega z), the cable's crossing.
STEPS = {"omega": 2e-6, "z": 2e-6, "theta": 1e-5, "height": 1e-6, "speed": 1e-4}


@pytest.mark.soak
@settings(max_examples=300)
@given(parts=st.sampled_from(ALL), seed=st.integers(0, 2**32 - 1))
def test_every_combinations_matrices_are_its_slopes(parts, seed):
    model = parts.build()
    x, u, p = random_point(model, random.Random(seed)).of(model)
    found = linearize(model, np.array(x), np.array(u), np.array(p))
    x_steps = [STEPS.get(name, 1e-4) for name in model.state_names]
    u_steps = [1e-4] * len(u)
    for name, function, point, steps in (
        ("A", lambda v: model.derivative(v, u, p), x, x_steps),
        ("B", lambda v: model.derivative(x, v, p), u, u_steps),
        ("C", lambda v: outputs_of(model, v, u, p), x, x_steps),
        ("D", lambda v: outputs_of(model, x, v, p), u, u_steps),
    ):
        expected, rounding = differences(function, point, steps)
        matrix = getattr(found, name)
        assert matrix.shape == expected.shape
        # What is left of the bend, relative to the column's largest slope in that row.
        size = np.abs(expected).max(axis=1, keepdims=True)
        allowed = 1e-6 * np.abs(expected) + 1e-9 * size + 30.0 * rounding + 1e-12
        worst = np.argmax(np.abs(matrix - expected) / allowed)
        i, j = np.unravel_index(worst, matrix.shape)
        assert np.all(np.abs(matrix - expected) <= allowed), (
            f"{parts}: {name}[{i}, {j}] is {matrix[i, j]} and not {expected[i, j]}"
        )


# --- the thesis's matrices ------------------------------------------------------------------


def partials(parts, q, omega, z, i_b):
    """df_z/domega, df_z/dz and the brake torque's slopes in i_b, omega, z, by hand.

    (3.30) to (3.34) as differentiated anew from (3.26), (3.15), and the same for (3.27), (3.28)
    with (3.19).
    """
    rho, sign = q["rho"], math.copysign(1.0, i_b)
    if parts.hysteresis == "bouc-wen":
        n, gamma, beta, A = parts.exponent, q["gamma"], q["beta"], q["A"]
        w, t = math.tanh(rho * z), math.tanh(rho * omega * z)
        size = (w * z) ** n
        f_omega = A - size * (beta + gamma * t + gamma * rho * omega * z * (1.0 - t**2))
        f_z = -n * omega * (w * z) ** (n - 1.0) * (rho * z * (1.0 - w**2) + w) * (
            beta + gamma * t
        ) - gamma * rho * omega**2 * size * (1.0 - t**2)
    else:
        t = math.tanh(rho * omega)
        bend = rho * omega * (1.0 - t**2)
        if parts.hysteresis == "dahl":
            f_omega, f_z = q["sigma"] * (1.0 - z * (t + bend)), -q["sigma"] * omega * t
        else:
            f_omega, f_z = 1.0 - q["zeta"] * z * (t + bend), -q["zeta"] * omega * t
    i = abs(i_b)
    by_current = sign * (q["alpha1"] * z + q["c1"] * omega)
    by_omega = q["c0"] + q["c1"] * i
    by_z = q["alpha0"] + q["alpha1"] * i
    if parts.hysteresis == "lugre":
        epsilon = q["epsilon0"] + q["epsilon1"] * i
        rate = omega - q["zeta"] * omega * t * z
        by_current += sign * q["epsilon1"] * rate
        by_omega += epsilon * f_omega
        by_z += epsilon * f_z
    return f_omega, f_z, by_current, by_omega, by_z


def thesis_matrices(parts, point):
    """(3.29) with (3.35), (3.36) or their open-loop counterparts; 1/J once, in the fifth row."""
    x, _u, q = point
    f_omega, f_z, by_current, by_omega, by_z = partials(
        parts, q, x["omega"], x["z"], x["current_brake"]
    )
    J = q["n_c"] ** 2 * q["J_m"] + q["J_b"]
    A, B = np.zeros((7, 7)), np.zeros((7, 3))
    for row, (k, kind) in enumerate((("m", parts.driver_motor), ("b", parts.driver_brake))):
        cutoff = q[f"omega_d{k}"]
        A[row, row] = -cutoff
        if kind == "closed":
            A[row, row + 2] = -q[f"K_d{k}"] * cutoff
            B[row, row] = q["K_v2i"] * q[f"K_d{k}"] * cutoff
        else:
            B[row, row] = q[f"G_d{k}"] * cutoff
        A[row + 2, row] = 1.0 / q[f"L_{k}"]
        A[row + 2, row + 2] = -q[f"R_{k}"] / q[f"L_{k}"]
    A[2, 4] = q["n_c"] * q["K_m"] / q["L_m"]
    A[4, 2:6] = [
        -q["n_c"] * q["K_m"] / J,
        -by_current / J,
        -(q["n_c"] ** 2) * q["B_m"] / J - by_omega / J,
        -by_z / J,
    ]
    B[4, 2] = 1.0 / J
    A[5, 4:6] = f_omega, f_z
    A[6, 4] = 1.0
    return A, B


@pytest.mark.parametrize("brake", ["closed", "open"])
@pytest.mark.parametrize("motor", ["closed", "open"])
@pytest.mark.parametrize(("kind", "n"), HYSTERESES)
def test_the_smooth_forms_have_the_thesiss_matrices_where_those_are_corrected(
    kind, n, motor, brake
):
    parts = Parts(motor, brake, kind, n, smooth=True)
    model, rng = parts.build(), random.Random(7)
    for _ in range(20):
        point = random_point(model, rng)
        x, u, p = (np.array(values) for values in point.of(model))
        A, B, C, D = linearize(model, x, u, p)
        for found, expected in zip((A, B), thesis_matrices(parts, point), strict=True):
            # The slopes of z are differences of larger terms.
            size = np.abs(expected).max(axis=1, keepdims=True)
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * size.max())
        np.testing.assert_array_equal(C, np.eye(7)[[2, 3, 4]])
        np.testing.assert_array_equal(D, np.zeros((3, 3)))


def printed_partials(q, n, omega, z, J):
    """(3.30), (3.31), (3.32) as the thesis prints them."""
    rho, gamma, beta, A = q["rho"], q["gamma"], q["beta"], q["A"]
    w, t = math.tanh(rho * z), math.tanh(rho * omega * z)
    size = (w * z) ** n
    return {
        "(3.30)": A - size * (beta + gamma * t - gamma * rho * omega * z * (1.0 - t**2)),
        "(3.31)": -n * (w * z) ** (n - 1.0) * (rho * z * (1.0 - w**2) + w) * (beta + t)
        - gamma * rho * omega * size * (1.0 - t**2),
        "(3.32)": q["alpha1"] / J * z - q["c1"] / J * omega,
    }


@pytest.mark.parametrize("n", [1.0, 2.0])
def test_the_printed_slopes_are_not_those_of_the_printed_equations(n):
    """Documents the thesis's errata, by finite differences of (3.26) and (3.15) alone."""
    q = {"gamma": 28.0, "beta": 20.0, "A": 60.0, "rho": 10.0, "alpha0": 0.02, "alpha1": 3.0}
    q |= {"c0": 1e-4, "c1": 0.05}
    omega, z, i_b, J = 0.3, 0.4, 0.1, 1e-4

    def of_motion(v):
        size = (math.tanh(q["rho"] * v[1]) * v[1]) ** n
        turned = math.tanh(q["rho"] * v[0] * v[1])
        return (v[0] * (q["A"] - size * (q["beta"] + q["gamma"] * turned)),)

    def of_current(v):
        alpha, c = q["alpha0"] + q["alpha1"] * v[0], q["c0"] + q["c1"] * v[0]
        return ((alpha * z + c * omega) / J,)

    (slopes,), _ = differences(of_motion, (omega, z), [1e-4, 1e-4])
    (by_current,), _ = differences(of_current, (i_b,), [1e-4])
    exact = {"(3.30)": slopes[0], "(3.31)": slopes[1], "(3.32)": by_current[0]}
    for number, printed in printed_partials(q, n, omega, z, J).items():
        assert abs(printed - exact[number]) > 0.01 * abs(exact[number]), number
    corrected = partials(Parts(exponent=n, smooth=True), q, omega, z, i_b)
    expected = (exact["(3.30)"], exact["(3.31)"], exact["(3.32)"] * J)
    assert corrected[:3] == pytest.approx(expected, rel=1e-8)


def test_a_lugre_brake_without_epsilons_part_has_other_slopes():
    """(3.33), (3.34) hold for Bouc-Wen and Dahl; LuGre adds epsilon times the slopes of z."""
    parts = Parts(hysteresis="lugre", smooth=True)
    model = parts.build()
    point = random_point(model, random.Random(3))
    x, u, p = (np.array(values) for values in point.of(model))
    A = linearize(model, x, u, p).A
    q, i = point.q, abs(point.x["current_brake"])
    J = q["n_c"] ** 2 * q["J_m"] + q["J_b"]
    plain = -(q["n_c"] ** 2 * q["B_m"] + q["c0"] + q["c1"] * i) / J
    assert abs(A[4, 4] - plain) > 0.01 * abs(plain)


# --- operating points -----------------------------------------------------------------------

# Parts, inputs by name, states to hold, where to start.
OPERATING_POINTS = [
    (Parts(), {"applied_voltage_brake": 0.1}, {"omega": 3.0, "theta": 0.0}, {}),
    (Parts(smooth=True), {"torque": 0.02}, {"omega": -5.0, "theta": 1.0}, {"z": -1.0}),
    (
        Parts("open", "open", "dahl", friction="stribeck", load="free"),
        {"applied_voltage_motor": 1.0},
        {"omega": 4.0, "theta": 0.0},
        {},
    ),
    (
        Parts(hysteresis="lugre", smooth=True, friction="cyclic", load="free", sensor="between"),
        {"applied_voltage_brake": 0.2},
        {"omega": 2.0, "theta": 0.7},
        {},
    ),
    (
        Parts("closed", "open", "lugre", load="locked", limits=True),
        {"applied_voltage_motor": 8.0, "applied_voltage_brake": 0.3},
        {"omega": 0.0, "theta": 0.5, "z": 0.0},
        {},
    ),
    (
        Parts("open", "closed", "bouc-wen", 2.0, smooth=True, load="pulley"),
        {"applied_voltage_motor": 0.1},
        {"omega": 0.0, "theta": 10.0},
        {"height": 0.049},
    ),
    (
        Parts(hysteresis="dahl", smooth=True, friction="stribeck", load="hand"),
        {"hand_grip": 1.0, "hand_theta": 0.5, "applied_voltage_motor": 0.3},
        {"omega": 0.0, "z": 0.2},
        {},
    ),
    (
        Parts(load="pulley+hand", limits=True),
        {"hand_grip": 1.0, "hand_theta": 8.0, "applied_voltage_motor": 0.1},
        {"omega": 0.0, "z": 0.0},
        {"theta": 8.0, "height": 0.039},
    ),
]


@pytest.mark.parametrize(
    ("parts", "inputs", "hold", "start"), OPERATING_POINTS, ids=lambda value: str(value)[:40]
)
def test_an_operating_point_is_found_at_which_all_that_is_free_rests(parts, inputs, hold, start):
    model = parts.build(parameters="rig")
    u = np.array([inputs.get(name, 0.0) for name in model.input_names])
    names = model.state_names
    guess = np.array([start.get(s.name, s.initial) for s in model.states])
    x = equilibrium(model, u, guess=guess, hold=hold)
    slopes = np.array(model.derivative(tuple(x), tuple(u), tuple(model.nominal)))
    scale = np.abs(linearize(model, x, u).A) @ np.maximum(np.abs(x), 1e-6) + 1e-3
    free = [i for i, name in enumerate(names) if name not in hold]
    assert np.all(np.abs(slopes[free]) <= 1e-8 * scale[free])
    for name, value in hold.items():
        assert x[names.index(name)] == value
    at = dict(zip(names, x, strict=True))
    asked = 0.5 * inputs.get("applied_voltage_brake", 0.0)
    assert at["current_brake"] == pytest.approx(asked, rel=0.01, abs=1e-9)
    if hold["omega"] != 0.0:
        slide = {"bouc-wen": 60.0 / 48.0, "dahl": 1.0, "lugre": 1.0 / 48.0}[parts.hysteresis]
        assert at["z"] == pytest.approx(math.copysign(slide, hold["omega"]), rel=1e-6)


@pytest.mark.parametrize("parts", [Parts(smooth=True), Parts(exponent=2.0)], ids=str)
def test_sliding_is_found_from_the_declared_state_too(parts):
    model = parts.build(parameters="rig")
    x = equilibrium(model, np.zeros(3), hold={"omega": 3.0, "theta": 0.0})
    assert x[model.state_names.index("z")] == pytest.approx(60.0 / 48.0, rel=1e-6)


def test_without_holding_the_angle_a_turning_shaft_has_no_operating_point():
    model = Parts(load="free").build(parameters="rig")
    with pytest.raises(ModelError, match="no equilibrium found"):
        equilibrium(model, np.array([1.0, 0.0]), hold={"omega": 3.0})


# --- python-control -------------------------------------------------------------------------


@pytest.mark.parametrize("case", [0, 1, 2, 3, 6])
def test_python_control_takes_the_matrices_and_gives_their_frequency_response(case):
    control = pytest.importorskip("control")
    parts, inputs, hold, start = OPERATING_POINTS[case]
    model = parts.build(parameters="rig")
    u = np.array([inputs.get(name, 0.0) for name in model.input_names])
    guess = np.array([start.get(s.name, s.initial) for s in model.states])
    x = equilibrium(model, u, guess=guess, hold=hold)
    A, B, C, D = linear = linearize(model, x, u)
    system = control.ss(*linear)
    assert (system.nstates, system.ninputs, system.noutputs) == (
        len(model.states), len(model.inputs), len(model.outputs),
    )  # fmt: skip
    for frequency in (1.0, 30.0, 1000.0, 20_000.0):
        s = 1j * frequency
        expected = C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D
        size = np.abs(expected).max(axis=1, keepdims=True) + 1e-30
        np.testing.assert_allclose(system(s) / size, expected / size, atol=1e-8)


def test_the_linear_models_response_to_a_small_step_is_the_nonlinear_ones():
    """Around sliding at 3 rad/s, for a sine on the motor's command."""
    control = pytest.importorskip("control")
    parts, inputs, hold, _start = OPERATING_POINTS[3]
    model = parts.build(parameters="rig")
    u = np.array([inputs.get(name, 0.0) for name in model.input_names])
    x = equilibrium(model, u, hold=hold)
    p = tuple(model.nominal)
    y0 = np.array(outputs_of(model, tuple(x), tuple(u), p))
    offset = np.array(model.derivative(tuple(x), tuple(u), p))  # the held states drift
    times = np.linspace(0.0, 0.02, 201)
    size = 1e-5
    push = size * np.sin(400.0 * times)
    system = control.ss(*linearize(model, x, u))
    linear = control.forced_response(system, times, np.vstack([push, 0.0 * push]))
    from scipy.integrate import solve_ivp

    def rhs(t, v):
        now = (u[0] + size * math.sin(400.0 * t), u[1])
        return np.array(model.derivative(tuple(v), now, p)) - offset

    solved = solve_ivp(
        rhs, (0.0, times[-1]), x, method="LSODA", rtol=1e-11, atol=1e-13, t_eval=times
    )
    found = np.array([outputs_of(model, tuple(v), tuple(u), p) for v in solved.y.T]) - y0
    for name in ("current_motor", "omega", "theta"):
        i = model.output_names.index(name)
        scale = np.abs(linear.outputs[i]).max()
        assert scale > 0.0
        np.testing.assert_allclose(found[:, i] / scale, linear.outputs[i] / scale, atol=2e-3)
