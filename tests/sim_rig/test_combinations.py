"""Every combination of parts: it can be built, and is its equations."""

from __future__ import annotations

import itertools
import random
from dataclasses import asdict

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset, ModelError, SearchSpace
from tests.sim_rig import equations
from tests.sim_rig.support import (
    ALL,
    AMPLIFIER,
    AMPLIFIERS,
    HYSTERESES,
    LOADS,
    PLANTS,
    Parts,
    combinations,
    random_point,
)
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import outputs_of


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("hysteresis", HYSTERESES, ids=str)
@pytest.mark.parametrize("smooth", mostly_soak([False, True]), ids=["exact", "smooth"])
def test_every_combination_is_its_equations(hysteresis, smooth, load):
    rng = random.Random(1)
    for parts in combinations(hysteresis=hysteresis, smooth=smooth, load=load):
        model = parts.build()
        point = random_point(model, rng)
        x, u, p = point.of(model)
        terms = equations.rates(parts, point.q, point.x, point.u)
        found = dict(zip(model.state_names, model.derivative(x, u, p), strict=True))
        assert set(found) == set(terms)
        for name, value in found.items():
            assert_sum(value, terms[name], f"{parts}: d{name}/dt")
        outputs = dict(zip(model.output_names, outputs_of(model, x, u, p), strict=True))
        for name in set(outputs) - {"torque"}:
            assert outputs[name] == point.x[name]
        assert ("torque" in outputs) == (load != "measured")
        if load != "measured":
            acceleration = sum(terms["omega"])
            reading = equations.sensor_reading(parts, point.q, point.x, point.u, acceleration)
            # The acceleration's own terms cancel too.
            cancelling = equations.total_inertia(parts, point.q) * sum(map(abs, terms["omega"]))
            assert_sum(outputs["torque"], reading, f"{parts}: torque", cancelling)


def assert_sum(value, terms, what, further=0.0):
    """Terms cancel: what is left is judged by the size of what it is made of."""
    size = sum(abs(term) for term in terms) + further
    assert abs(value - sum(terms)) <= 1e-13 * size, f"{what}: {value} and not {sum(terms)}"


def test_there_are_as_many_combinations_as_the_choices_say():
    assert len(ALL) == len(set(ALL)) == 2 * 2 * 2 * 5 * 2 * 3 * (6 * 2 - 1) * 2


OTHER_PARTS = (
    ("driver_motor",), ("driver_brake",), ("hysteresis", "exponent"), ("smooth",), ("friction",),
    ("load",), ("sensor",), ("limits",),
)  # fmt: skip


@pytest.mark.parametrize("choice", OTHER_PARTS, ids=str)
def test_every_amplifier_meets_every_other_part(choice):
    there = {tuple(getattr(parts, name) for name in (*AMPLIFIER, *choice)) for parts in ALL}
    values = {tuple(getattr(parts, name) for name in choice) for parts in ALL}
    assert there == {(*amplifier, *value) for amplifier in AMPLIFIERS for value in values}


def test_at_rest_nothing_moves_but_a_mass_that_falls_onto_its_cable():
    some, all_choices = (
        {choice for parts in which for choice in asdict(parts).items()} for which in (ALL[::7], ALL)
    )
    assert some == all_choices
    for parts in ALL[::7]:
        model = parts.build()
        u, p = (0.0,) * len(model.inputs), tuple(model.nominal)
        slopes = model.derivative(tuple(model.initial_state), u, p)
        np.testing.assert_allclose(slopes, 0.0, atol=1e-9, err_msg=str(parts))


@pytest.mark.parametrize("name", ["nominal", "rig", "A", "B", "C", "D"])
def test_every_combination_takes_every_named_set(name):
    amplifiers = itertools.cycle(AMPLIFIERS)
    for motor, brake, (hysteresis, exponent), friction in itertools.product(
        ("closed", "open"), ("closed", "open"), HYSTERESES, ("none", "cyclic")
    ):
        model = actuator(
            **dict(zip(AMPLIFIER, next(amplifiers), strict=True)),
            driver_motor=motor,
            driver_brake=brake,
            hysteresis=hysteresis,
            exponent=exponent,
            friction=friction,
            parameters=name,
        )
        assert all(
            constraint.function(tuple(model.nominal)) <= 0.0 for constraint in model.constraints
        )


def test_a_measured_load_has_its_sensor_at_the_load():
    with pytest.raises(ModelError, match="sensor between"):
        actuator(load="measured", sensor="between")


# --- compiled ------------------------------------------------------------------------------

# A machine-code model takes seconds to build. These few have, with the plants of the simulated
# device's tests, every part and the pairs below.
COMPILED = (
    Parts("open", "closed", "bouc-wen", 1.5, True, "cyclic", "measured", "load", False, 2, 3),
    Parts("closed", "closed", "lugre", 1.0, False, "stribeck", "measured", "load", False, 3, 2),
    Parts("closed", "open", "dahl", 1.0, True, "none", "free", "between", False, 2, 1, True, True),
    Parts("open", "closed", "lugre", 1.0, True, "stribeck", "pulley", "load", True, 1, 2),
)
PAIRS = (
    ("driver_motor", "driver_brake"),
    ("driver_motor", "limits"),
    ("driver_brake", "limits"),
    ("driver_motor", "smooth"),
    ("driver_brake", "smooth"),
    ("smooth", "friction"),
    ("sensor", "friction"),
    ("sensor", "limits"),
    ("smooth", "sensor"),
)


def of_device(settings):
    """The parts of a simulated rig's plant; a handle is always there, unless it is locked."""
    load = {"locked": "locked", "pulley": "pulley+hand"}.get(settings.get("load", "pulley"), "hand")
    kept = {k: v for k, v in settings.items() if not k.startswith("parameter")}
    return Parts(**(kept | {"load": load, "limits": True}))


def test_the_compiled_ones_have_every_part_and_the_pairs_that_meet_in_an_equation():
    compiled = [*COMPILED, of_device({}), *map(of_device, PLANTS.values())]
    parts_alone = [("exponent",), ("load",), *((name,) for name in AMPLIFIER)]
    for choices in [*parts_alone, ("hysteresis", "smooth"), *PAIRS]:
        there, possible = (
            {tuple(getattr(parts, name) for name in choices) for parts in which}
            for which in (compiled, ALL)
        )
        assert there == possible, choices


def excitation(model, n=40, dt=1.0 / 800.0):
    """Steps of the commands, and a load or a hand that moves; the hand lets go for a while."""
    rng = np.random.default_rng(11)
    t = dt * np.arange(n)
    signals = {
        "applied_voltage_motor": np.repeat(rng.uniform(-3.0, 3.0, n // 5), 5),
        "applied_voltage_brake": np.repeat(rng.choice([0.0, 0.1, 0.25], n // 10), 10),
        "torque": 0.08 * np.sin(60.0 * t) + 0.03,
        "hand_grip": (t % 0.05 < 0.035).astype(float),
        "hand_theta": 0.8 * np.sin(20.0 * t),
        "hand_omega": 16.0 * np.cos(20.0 * t),
    }
    inputs = np.column_stack([signals[name] for name in model.input_names])
    return Dataset(inputs, np.full((n, len(model.outputs)), np.nan), dt)


def feasible_rows(model, count, seed):
    """Parameters drawn from the search space, as a population is, those within constraints."""
    space, rng = SearchSpace.of(model), np.random.default_rng(seed)
    low, high = space.encode(space.lower), space.encode(space.upper)
    drawn = space.decode(rng.uniform(low, high, (200, len(low))))
    return space.full(drawn[space.violations(drawn).sum(axis=1) == 0.0][:count])


@pytest.mark.soak
@pytest.mark.parametrize("parts", COMPILED, ids=str)
def test_machine_code_simulates_what_scipy_does(parts):
    model = parts.build(parameters="rig")
    record = excitation(model)
    rows = np.vstack([model.nominal, feasible_rows(model, 1, seed=6)])
    found = BatchSimulator(model, accuracy=1e-4).trajectories(rows, record)
    for row, trajectory in zip(rows, found, strict=True):
        expected = reference(model, row, record, rtol=1e-7, atol=1e-9)
        for j, name in enumerate(model.output_names):
            peak = np.abs(expected[:, j]).max()
            error = np.sqrt(np.mean((trajectory[:, j] - expected[:, j]) ** 2))
            assert error <= 1e-4 * peak, f"{parts}: {name} by {error / peak}"
            assert peak > 1e-5, name
