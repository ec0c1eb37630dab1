"""The simulated rig's plant: ratings, what a rig's YAML may say, what identification gets."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from pydantic import ValidationError

from sim_rig.plant import Plant, state_sizes
from sysid import ModelError
from tests.sim_rig.support import HYSTERESES, constant, follow, random_point
from tests.sysid.support import outputs_of

# --- ratings --------------------------------------------------------------------------------

BRAKES = {
    "default": {},
    **{
        f"{kind} {n:g}{' smooth' * smooth}": {"hysteresis": kind, "exponent": n, "smooth": smooth}
        for kind, n in HYSTERESES
        for smooth in (False, True)
    },
    "open": {"driver_motor": "open", "driver_brake": "open"},
    "dahl open": {"driver_motor": "open", "driver_brake": "open", "hysteresis": "dahl"},
}
DRIVERS = [
    {"driver_motor": motor, "driver_brake": brake}
    for motor, brake in itertools.product(("closed", "open"), repeat=2)
]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("drivers", DRIVERS, ids=lambda d: "-".join(d.values()))
def test_the_motor_holds_its_rated_torque_at_its_rated_current(drivers, sign):
    """0.353 N*m at 2.5 A, asked for by 5 V; the lock takes it up, and its sensor shows it."""
    for sensor in ("load", "between"):
        model = Plant(load="locked", sensor=sensor, **drivers).build()
        found = follow(model, constant(model, applied_voltage_motor=sign * 5.0), 0.02)
        current, torque = found["current_motor"][-1], found.output("torque")
        assert sign * current == pytest.approx(2.5, rel=0.01)
        resisting = -1.0 if sensor == "load" else 1.0
        assert resisting * sign * torque == pytest.approx(0.353, rel=0.01)
        assert abs(torque / current) == pytest.approx(0.353 / 2.5, rel=1e-6)


@pytest.mark.parametrize("brake", BRAKES)
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_brake_slides_slowly_at_its_rated_torque(direction, brake):
    """0.6779 N*m at 0.19 A, turned by a heavily damped hand; 0.38 V ask for the current.

    The motor is taken out: its bearings, and what it generates into an open-loop driver.
    """
    model = Plant(load="hand", **BRAKES[brake]).build()
    speed = direction * 1.0
    alone = {"K_u": 0.0, "B_u": 100.0, "B_m": 0.0, "K_m": 0.0}
    found = []
    for command in (0.38, 0.0):
        inputs = constant(model, applied_voltage_brake=command, hand_grip=1.0, hand_omega=speed)
        found.append(follow(model, inputs, 0.2, alone, {"omega": speed}))
        assert found[-1]["omega"][-1] == pytest.approx(speed, rel=0.01)
    current = found[0]["current_brake"][-1]
    assert current == pytest.approx(0.19, rel=0.01)
    rated, residual = (direction * trajectory.output("torque") for trajectory in found)
    assert rated == pytest.approx(0.6779, rel=0.01)
    assert 0.02 * 0.6779 < residual < 0.022 * 0.6779


@pytest.mark.parametrize("drivers", DRIVERS, ids=lambda d: "-".join(d.values()))
@pytest.mark.parametrize(
    ("channel", "command"), [("motor", 0.4), ("motor", -4.0), ("brake", 0.05), ("brake", 0.37)]
)
def test_both_channels_give_half_an_ampere_per_volt_at_rest(channel, command, drivers):
    """Open-loop drivers the same as closed-loop ones, into their own windings."""
    model = Plant(load="locked", **drivers).build()
    found = follow(model, constant(model, **{f"applied_voltage_{channel}": command}), 0.05)
    current = found[f"current_{channel}"][-1]
    assert current / command == pytest.approx(0.5, rel=0.01)


def test_the_plants_amplifiers_end_at_24_volts_and_at_the_rated_current():
    model = Plant(load="locked", parameters={"R_b": 250.0}).build()
    inputs = constant(model, applied_voltage_motor=9.0, applied_voltage_brake=0.4)
    found = follow(model, inputs, 0.05)
    assert found["current_motor"][-1] == pytest.approx(2.5, rel=0.011)
    assert found["current_brake"][-1] == pytest.approx(24.0 / 250.0, rel=1e-3)


def test_the_three_models_are_one_brake():
    """The same torque over angle, loading and turning back, at the same current."""
    torques = []
    for hysteresis in ("bouc-wen", "dahl", "lugre"):
        model = Plant(load="hand", hysteresis=hysteresis).build()

        def inputs(t):
            return (0.0, 0.2, 1.0, 0.0, 2.0 if t < 0.1 else -2.0)

        times = np.array([0.08, 0.09, 0.103, 0.17, 0.19])
        changes = {"K_u": 0.0, "B_u": 100.0}
        found = follow(model, inputs, 0.19, changes, {"omega": 2.0}, max_step=1e-3, times=times)
        torques.append([found.output("torque", row) for row in range(len(times))])
    # Sliding they are the same; in between Bouc-Wen unloads along a straighter line.
    np.testing.assert_allclose(np.array(torques)[:, [0, 1, 3, 4]] / torques[0][0],
                               [[1.0, 1.0, -1.0, -1.0]] * 3, rtol=0.02)  # fmt: skip
    assert np.ptp(np.array(torques)[:, 2]) < 0.35 * abs(torques[0][0])


# --- the rig's YAML -------------------------------------------------------------------------

CHOICES = [
    {"load": load, "friction": friction, "sensor": sensor, "hysteresis": kind, "smooth": smooth}
    for load, friction, sensor, kind, smooth in itertools.product(
        ("free", "locked", "pulley", "hand"),
        ("none", "stribeck", "cyclic"),
        ("load", "between"),
        ("bouc-wen", "dahl", "lugre"),
        (False, True),
    )
]


def test_every_choice_is_a_plant_with_the_rigs_signals():
    for choice in CHOICES:
        plant = Plant(**choice)
        model = plant.build()
        assert model.output_names == (
            "current_motor", "current_brake", "torque", "theta", "omega",
        )  # fmt: skip
        hand = () if choice["load"] == "locked" else ("hand_grip", "hand_theta", "hand_omega")
        assert model.input_names[2:] == hand
        assert model.state_names[6] == "theta"
        assert ("mass" in model.parameter_names) == (choice["load"] == "pulley")
        sizes = state_sizes(model)
        assert sizes.shape == (len(model.states),)
        assert np.all((sizes > 0.0) & np.isfinite(sizes))


@pytest.mark.parametrize("kind", ["bouc-wen", "dahl", "lugre"])
def test_the_size_of_z_is_where_the_brake_slides(kind):
    found = state_sizes(Plant(hysteresis=kind).build())[5]
    assert found == pytest.approx({"bouc-wen": 1.25, "dahl": 1.0, "lugre": 1.0 / 48.0}[kind])


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("bouc-wen", {"beta": 0.0, "gamma": 0.0}),
        ("bouc-wen", {"A": 0.0}),
        ("lugre", {"zeta": 0.0}),
    ],
)
def test_a_brake_that_never_slides_still_has_sizes(kind, values):
    sizes = state_sizes(Plant(hysteresis=kind, parameters=values).build())
    assert np.all((sizes > 0.0) & np.isfinite(sizes))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parameters": {"R_x": 1.0}}, "no parameter 'R_x'; it has K_dm"),
        ({"parameters": {"R_m": math.inf}}, r"parameters\.R_m\s+Input should be a finite number"),
        ({"parameters": {"R_m": math.nan}}, r"parameters\.R_m\s+Input should be a finite number"),
        ({"parameters": {"R_m": "much"}}, r"parameters\.R_m\s+Input should be a valid number"),
        ({"parameters": {"R_m": True}}, "parameter R_m: .* yes, no"),
        ({"parameters": {"R_m": -1.0}}, r"parameter R_m: .* -1\.0 is outside its physical limits"),
        ({"parameters": {"mass": -0.1}}, "parameter mass: .* outside its physical limits"),
        ({"parameters": {"L_m": 0.0}}, "parameter L_m: .* divides by zero"),
        ({"parameters": {"mass": 0.0}}, "parameter mass: .* divides by zero"),
        (
            {"friction": "stribeck", "parameters": {"omega_r": 0.0}},
            "parameter omega_r: .* divides by zero",
        ),
        # Parts that are not there have no values.
        ({"load": "hand", "parameters": {"mass": 0.2}}, "no parameter 'mass'"),
        ({"driver_motor": "open", "parameters": {"K_dm": 100.0}}, "no parameter 'K_dm'"),
        ({"parameters": {"F_c": 0.01}}, "no parameter 'F_c'"),
        ({"parameters": {"rho": 100.0}}, "no parameter 'rho'"),
        # No brake gives energy, and no friction drives.
        ({"parameters": {"gamma": 10.0, "beta": 20.0}}, "violate gamma - beta >= 0"),
        ({"friction": "stribeck", "parameters": {"F_s": 0.001}}, "violate F_s >= F_c"),
        ({"friction": "cyclic", "parameters": {"F_cos": 0.3}}, "violate F_c >= "),
        ({"hysteresis": "dahl", "exponent": 2.0}, "not dahl"),
        ({"exponent": 0.5}, "exponent"),
        ({"load": "measured"}, "load"),
        ({"driver_motor": "both"}, "driver_motor"),
        ({"parameter_set": "E"}, "parameter_set"),
        ({"lode": "hand"}, "lode"),
    ],
)
def test_what_is_impossible_is_refused_by_name(settings, message):
    with pytest.raises(ValidationError, match=message):
        Plant.model_validate(settings)


def test_values_take_effect():
    plant = Plant(friction="cyclic", parameter_set="C", parameters={"R_b": 99.0, "cycles": 3.0})
    for model in (plant.build(), plant.process_model()):
        values = dict(zip(model.parameter_names, model.nominal, strict=True))
        assert (values["R_b"], values["cycles"], values["R_m"]) == (99.0, 3.0, 6.61)
    assert Plant(parameters={"mass": 0.5}).build().parameter("mass").nominal == 0.5
    with pytest.raises(ModelError, match="mass"):
        Plant(parameters={"mass": 0.5}).process_model().parameter("mass")


# --- what identification gets ---------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"load": "free", "hysteresis": "lugre", "friction": "cyclic"},
        {"load": "hand", "driver_motor": "open", "driver_brake": "open", "hysteresis": "dahl"},
        {"exponent": 2.0, "smooth": True, "friction": "stribeck", "parameters": {"n_c": 2.0}},
    ],
)
def test_the_model_that_is_identified_is_the_actuator_inside_the_plant(settings):
    """Within the amplifiers' limits, given the torque that the plant's sensor shows."""
    plant = Plant(**settings)
    whole, inner = plant.build(), plant.process_model()
    rng = random.Random(5)
    assert inner.output_names == ("current_motor", "current_brake", "omega")
    for _ in range(50):
        point = random_point(whole, rng)
        x = point.x | {"voltage_motor": 9.0, "voltage_brake": -3.0, "current_motor": 1.2}
        x["current_brake"] = 0.1
        u = point.u | {"applied_voltage_motor": -2.0, "applied_voltage_brake": 0.3}
        q = dict(zip(whole.parameter_names, whole.nominal, strict=True))
        at = point._replace(x=x, u=u, q=q).of(whole)
        torque = outputs_of(whole, *at)[2]
        expected = whole.derivative(*at)[:7]
        known = point._replace(x=x, u=u | {"torque": torque}, q=q)
        found = inner.derivative(*known.of(inner))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("load", ["free", "pulley", "locked"])
def test_without_the_loads_torque_in_the_log_the_model_has_the_load_itself(load):
    plant = Plant(load=load, sensor="between", friction="stribeck")
    whole, inner = plant.build(), plant.process_model()
    assert inner.input_names == ("applied_voltage_motor", "applied_voltage_brake")
    assert "torque" in inner.output_names
    rng = random.Random(6)
    for _ in range(20):
        point = random_point(whole, rng)
        x = point.x | {"voltage_motor": 9.0, "voltage_brake": -3.0, "current_motor": 1.2}
        x["current_brake"] = 0.1
        u = point.u | {"applied_voltage_motor": -2.0, "applied_voltage_brake": 0.3}
        u |= {"hand_grip": 0.0} if "hand_grip" in u else {}
        q = dict(zip(whole.parameter_names, whole.nominal, strict=True))
        at = point._replace(x=x, u=u, q=q)
        expected, found = whole.derivative(*at.of(whole)), inner.derivative(*at.of(inner))
        np.testing.assert_allclose(found, expected[: len(found)], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            outputs_of(inner, *at.of(inner)), outputs_of(whole, *at.of(whole)), rtol=1e-9
        )


def test_no_model_follows_a_hand_that_is_not_measured():
    with pytest.raises(ModelError, match="put the sensor at the load"):
        Plant(load="hand", sensor="between").process_model()


def test_a_locked_shaft_stays_where_noise_says_it_turns():
    model = Plant(load="locked").build()
    x = model.initial_state
    x[model.state_names.index("omega")] = 0.3
    rates = model.derivative(tuple(x), (0.0, 0.0), tuple(model.nominal))
    assert rates[model.state_names.index("theta")] == 0.0
    assert rates[model.state_names.index("z")] == 0.0
