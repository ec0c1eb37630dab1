"""The assembled actuator: signals, named sets, transmission, torque sensor."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import ModelError, SearchSpace, equilibrium, linearize
from tests.sim_rig import equations
from tests.sim_rig.support import (
    AMPLIFIER,
    HYSTERESES,
    LOADS,
    Parts,
    constant,
    follow,
    random_point,
)
from tests.sysid.support import outputs_of

ALL_OUTPUTS = ("current_motor", "current_brake", "torque", "theta", "omega")

# --- signals --------------------------------------------------------------------------------


@pytest.mark.parametrize("load", LOADS)
def test_outputs_are_those_of_the_thesis_for_a_measured_load_and_the_rigs_for_others(load):
    model = Parts(load=load).build()
    measured = ("current_motor", "current_brake", "omega")  # (3.24)
    assert model.output_names == (measured if load == "measured" else ALL_OUTPUTS)


@pytest.mark.parametrize("load", LOADS)
def test_inputs_are_held_as_they_are_made(load):
    """Converters hold their value; what is measured or moves by hand is taken as a line."""
    model = Parts(load=load).build()
    holds = {signal.name: signal.hold for signal in model.inputs}
    expected = {"applied_voltage_motor": "zoh", "applied_voltage_brake": "zoh"}
    if load == "measured":
        expected["torque"] = "foh"
    if "hand" in load:
        expected |= {"hand_grip": "zoh", "hand_theta": "foh", "hand_omega": "foh"}
    assert holds == expected
    assert list(holds)[:2] == ["applied_voltage_motor", "applied_voltage_brake"]


@pytest.mark.parametrize("load", ["measured", "pulley+hand"])
def test_outputs_may_be_chosen_in_any_order(load):
    rng = random.Random(2)
    whole = Parts(load=load).build()
    point = random_point(whole, rng).of(whole)
    values = dict(zip(whole.output_names, outputs_of(whole, *point), strict=True))
    values["theta"] = point[0][whole.state_names.index("theta")]
    for count in (1, 2, 3, len(values)):
        names = tuple(rng.sample(list(values), count))
        model = Parts(load=load).build(outputs=names)
        assert model.output_names == names
        assert outputs_of(model, *point) == tuple(values[name] for name in names)
        assert model.derivative(*point) == whole.derivative(*point)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"outputs": ("omega", "speed")}, "no output 'speed'; it has current_motor"),
        ({"outputs": ("torque",)}, "the torque is an input"),
        ({"outputs": ("omega", "omega")}, "outputs repeat the name 'omega'"),
        ({"sensor": "between"}, "sensor between"),
        ({"hysteresis": "dahl", "exponent": 2.0}, "not dahl"),
        ({"exponent": 0.5}, "at least 1"),
        ({"order_brake": 4}, "order_brake 4: write 1 to 3"),
    ],
)
def test_what_does_not_go_together_is_refused(settings, message):
    with pytest.raises(ModelError, match=message):
        actuator(**settings)


def test_the_description_says_what_was_chosen():
    text = Parts("open", "closed", "dahl", 1.0, True, "cyclic", "pulley").build().description
    for word in ("open", "closed", "smooth Dahl", "cyclic", "pulley"):
        assert word in text
    plain = Parts().build().description
    assert "closed-loop drivers" in plain
    assert not any(word in plain for word in ("smooth", "friction", "open", "Dahl"))


def test_amplifiers_of_higher_order_are_described():
    same = Parts(order_motor=2, order_brake=2).build().description
    assert "second-order closed-loop drivers" in same
    differ = Parts(driver_brake="open", order_brake=3, output_resistance_motor=True)
    text = differ.build().description
    assert "closed-loop motor driver with output resistance" in text
    assert "and third-order open-loop brake driver, DC motor" in text


# --- named sets -----------------------------------------------------------------------------

TABLE_4_1 = {  # as printed; L_m in mH
    "A": (10.0, 400, 1.18, 4.80, 0.141),
    "B": (29.6, 1046, 3.44, 0.912, 0.373),
    "C": (112, 1828, 6.61, 1.18, 0.0597),
    "D": (379, 4517, 0.255, 0.768, 0.0985),
}


@pytest.mark.parametrize("row", TABLE_4_1)
@pytest.mark.parametrize(("kind", "n"), HYSTERESES)
def test_a_row_of_table_4_1_is_exactly_its_numbers_and_else_the_rig(row, kind, n):
    parts = Parts(hysteresis=kind, exponent=n, smooth=True, friction="cyclic", load="pulley+hand")
    model, rig = parts.build(parameters=row), parts.build(parameters="rig")
    K, cutoff, R, L, K_m = TABLE_4_1[row]
    expected = dict(zip(rig.parameter_names, rig.nominal, strict=True))
    expected |= {"K_dm": K, "omega_dm": cutoff, "R_m": R, "L_m": L * 1e-3, "K_m": K_m}
    found = dict(zip(model.parameter_names, model.nominal, strict=True))
    assert found == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("name", ["nominal", "rig", *TABLE_4_1])
def test_currents_settle_whatever_the_order_of_the_amplifiers(name, order):
    for motor, brake in itertools.product(("closed", "open"), repeat=2):
        parts = Parts(motor, brake, load="locked", order_motor=order, order_brake=order)
        model = parts.build(parameters=name)
        zeros = [np.zeros(len(part)) for part in (model.states, model.inputs)]
        A = linearize(model, *zeros).A
        electrical = [i for i, s in enumerate(model.state_names) if s[:4] in ("volt", "curr")]
        assert np.linalg.eigvals(A[np.ix_(electrical, electrical)]).real.max() < 0.0


@pytest.mark.parametrize(("kind", "n"), HYSTERESES)
@pytest.mark.parametrize("friction", ["none", "cyclic"])
def test_the_rigs_own_values_are_feasible_and_within_the_ranges_of_a_search(kind, n, friction):
    for motor, brake, order in itertools.product(("closed", "open"), ("closed", "open"), (1, 3)):
        amplifiers = dict(zip(AMPLIFIER, (order, order, order > 1, order > 1), strict=True))
        parts = Parts(motor, brake, kind, n, friction=friction, **amplifiers)
        model = parts.build(parameters="rig")
        space = SearchSpace.of(model)
        values = model.nominal[list(space.index)]
        assert np.all((values > space.lower) & (values < space.upper))
        assert np.all(space.violations(values[None]) == 0.0)
        nominal = parts.build()
        differing = nominal.nominal != model.nominal
        assert differing.sum() > 10  # identification does not start from the truth


@pytest.mark.parametrize("row", TABLE_4_1)
def test_the_ranges_of_a_search_hold_every_row_of_table_4_1(row):
    K, cutoff, R, L, K_m = TABLE_4_1[row]
    values = {"K_dm": K, "omega_dm": cutoff, "R_m": R, "L_m": 1e-3 * L, "K_m": K_m}
    parameters = {p.name: p for p in actuator().parameters}
    for name, value in values.items():
        assert parameters[name].lower < value < parameters[name].upper, name


def test_a_set_changes_no_range():
    nominal, rig = Parts().build(), Parts().build(parameters="C")
    for one, other in zip(nominal.parameters, rig.parameters, strict=True):
        assert (one.lower, one.upper, one.fixed) == (other.lower, other.upper, other.fixed)


# --- transmission ---------------------------------------------------------------------------


def test_a_gear_of_two_is_a_motor_of_half_the_constant_and_a_quarter_of_the_inertia():
    """To the bit, the factors being powers of two."""
    rng = random.Random(4)
    for load, sensor in (("measured", "load"), ("pulley", "between"), ("locked", "between")):
        model = Parts(load=load, sensor=sensor, friction="cyclic").build()
        for _ in range(20):
            point = random_point(model, rng)
            point.q["n_c"] = -1.0
            x, u, p = point.of(model)
            geared = point.q | {"n_c": -2.0}
            geared |= {"K_m": point.q["K_m"] / 2, "B_m": point.q["B_m"] / 4}
            geared["J_m"] = point.q["J_m"] / 4
            q = tuple(geared[name] for name in model.parameter_names)
            assert model.derivative(x, u, p) == model.derivative(x, u, q)
            assert outputs_of(model, x, u, p) == outputs_of(model, x, u, q)


def test_the_sign_of_the_transmission_is_the_sign_of_the_motors_current():
    rng = random.Random(5)
    model = Parts(load="pulley+hand", sensor="between").build()
    for _ in range(20):
        point = random_point(model, rng)
        turned = point._replace(
            x=point.x | {k: -point.x[k] for k in ("voltage_motor", "current_motor")},
            u=point.u | {"applied_voltage_motor": -point.u["applied_voltage_motor"]},
            q=point.q | {"n_c": -point.q["n_c"]},
        )
        one, other = (model.derivative(*at.of(model)) for at in (point, turned))
        signs = [-1.0 if "motor" in name else 1.0 for name in model.state_names]
        assert other == pytest.approx([s * v for s, v in zip(signs, one, strict=True)], rel=1e-12)
        torque = [outputs_of(model, *at.of(model))[2] for at in (point, turned)]
        assert torque[0] == pytest.approx(torque[1], rel=1e-12)


@pytest.mark.parametrize("n_c", [-1.0, 2.0, -3.5])
def test_a_motors_power_is_the_same_on_both_sides_of_the_gap(n_c):
    """Electrical power taken by the back-EMF and mechanical power: K i omega, from the model."""
    rng = random.Random(6)
    model = Parts(load="free").build()
    i_m, omega = (model.state_names.index(name) for name in ("current_motor", "omega"))
    for _ in range(20):
        point = random_point(model, rng)
        point.q["n_c"] = n_c
        q = point.q
        with_current = model.derivative(*point.of(model))
        still = point._replace(x=point.x | {"omega": 0.0})
        at_rest = model.derivative(*still.of(model))
        without = point._replace(x=point.x | {"current_motor": 0.0})
        unpowered = model.derivative(*without.of(model))
        back_emf = -q["L_m"] * (with_current[i_m] - at_rest[i_m])
        J = n_c**2 * q["J_m"] + q["J_b"]
        torque = J * (with_current[omega] - unpowered[omega])
        electrical = back_emf * point.x["current_motor"]
        mechanical = torque * point.x["omega"]
        assert mechanical == pytest.approx(electrical, rel=1e-7, abs=1e-12)
        expected = -n_c * q["K_m"] * point.x["current_motor"] * point.x["omega"]
        assert mechanical == pytest.approx(expected, rel=1e-7, abs=1e-12)


# --- torque sensor --------------------------------------------------------------------------


@pytest.mark.parametrize("load", ["free", "pulley", "hand", "pulley+hand"])
def test_between_motor_and_brake_it_reads_motor_less_its_inertia_which_is_what_is_beyond(load):
    """Both sides of the cut, each with the model's own acceleration (figure 2.2)."""
    rng = random.Random(7)
    for friction in ("none", "stribeck", "cyclic"):
        parts = Parts(hysteresis="lugre", friction=friction, load=load, sensor="between")
        model = parts.build()
        for _ in range(20):
            x, u, q = point = random_point(model, rng)
            slopes = dict(zip(model.state_names, model.derivative(*point.of(model)), strict=True))
            reading = outputs_of(model, *point.of(model))[2]
            motor = equations.motor_torque(q, x)
            own = q["n_c"] ** 2 * q["J_m"] * slopes["omega"]
            beyond = equations.sensor_reading(parts, q, x, u, slopes["omega"])
            size = sum(map(abs, [*motor, own, *beyond]))
            assert reading == pytest.approx(sum(motor) - own, rel=0, abs=1e-12 * size)
            assert reading == pytest.approx(sum(beyond), rel=0, abs=1e-12 * size)


def test_at_the_load_it_reads_what_the_load_gives_less_the_pulleys_inertia():
    rng = random.Random(8)
    parts = Parts(friction="cyclic", load="pulley+hand")
    model = parts.build()
    for _ in range(50):
        x, u, q = point = random_point(model, rng)
        slopes = dict(zip(model.state_names, model.derivative(*point.of(model)), strict=True))
        terms = [*equations.load_torque(parts, q, x, u), -q["J_p"] * slopes["omega"]]
        reading = outputs_of(model, *point.of(model))[2]
        assert reading == pytest.approx(sum(terms), abs=1e-12 * sum(map(abs, terms)))


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_brush_friction_is_seen_between_motor_and_brake_and_not_at_the_load(direction):
    """The motor turns a free shaft: the sensor at the load carries nothing, brushes or not."""
    speed, readings = direction * 4.0, {}
    for sensor, friction in itertools.product(("load", "between"), ("none", "stribeck")):
        model = Parts(load="free", sensor=sensor, friction=friction).build(parameters="rig")
        p = dict(zip(model.parameter_names, model.nominal, strict=True))

        def steady(voltage, model=model):
            u = np.array([voltage, 0.0])
            x = equilibrium(model, u, hold={"omega": speed, "theta": 0.0})
            slope = model.derivative(tuple(x), tuple(u), tuple(model.nominal))
            return slope[model.state_names.index("omega")], x, u

        # The command at which it runs steadily; the acceleration is linear in it.
        a, b = steady(0.0)[0], steady(1.0)[0]
        rest, x, u = steady(-a / (b - a))
        assert abs(rest) < 1e-6
        output = outputs_of(model, x, u, model.nominal)
        readings[sensor, friction] = output[model.output_names.index("torque")]
    assert readings["load", "none"] == readings["load", "stribeck"] == 0.0
    brake = p["alpha0"] * 60.0 / 48.0 + p["c0"] * 4.0
    brushes = p["F_c"] + (p["F_s"] - p["F_c"]) * math.exp(-((4.0 / 3.0) ** 2)) + p["B_f"] * 4.0
    assert readings["between", "none"] == pytest.approx(direction * brake, rel=1e-5)
    assert readings["between", "stribeck"] == pytest.approx(direction * (brake + brushes), rel=1e-5)


def test_a_hand_feels_the_brushes_through_the_sensor_at_the_load():
    """They rub on the sensor's brake side: whoever turns the shaft from the load carries them."""
    readings = {}
    for friction in ("none", "stribeck"):
        model = Parts(load="hand", friction=friction).build(parameters="rig")
        changes = {"K_u": 0.0, "B_u": 10.0}
        inputs = constant(model, hand_grip=1.0, hand_omega=4.0)
        readings[friction] = follow(model, inputs, 0.1, changes, {"omega": 4.0}).output("torque")
    p = dict(zip(model.parameter_names, model.nominal, strict=True))
    brushes = p["F_c"] + (p["F_s"] - p["F_c"]) * math.exp(-((4.0 / 3.0) ** 2)) + p["B_f"] * 4.0
    assert readings["stribeck"] - readings["none"] == pytest.approx(brushes, rel=0.01)


# --- smooth forms ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bouc-wen", "dahl", "lugre"])
def test_the_smooth_actuator_approaches_the_exact_one_as_rho_grows(kind):
    """Speed of a free shaft swung to and fro by its motor against the brake."""
    times = np.linspace(0.0, 0.08, 80)

    def speeds(smooth, **changes):
        model = Parts(hysteresis=kind, smooth=smooth, load="free").build(parameters="rig")

        def inputs(t):
            return 2.0 * math.sin(80.0 * t), 0.05

        return follow(model, inputs, times[-1], changes, times=times, rtol=1e-8)["omega"]

    exact = speeds(False)
    distances = []
    for rho in (0.1, 1.0, 10.0):
        distance = speeds(True, rho=rho) - exact
        distances.append(np.sqrt(np.mean(distance**2)) / np.sqrt(np.mean(exact**2)))
    assert all(after < before / 3.0 for before, after in itertools.pairwise(distances))
    assert distances[0] > 0.1
    assert distances[-1] < 0.01
