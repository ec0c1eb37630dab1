"""Every combination of parts: it can be built, and is its equations."""

from __future__ import annotations

import itertools
import random

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import ModelError
from tests.sim_rig import equations
from tests.sim_rig.support import ALL, HYSTERESES, LOADS, combinations, random_point


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("hysteresis", HYSTERESES, ids=str)
@pytest.mark.parametrize("smooth", [False, True], ids=["exact", "smooth"])
def test_every_combination_is_its_equations(hysteresis, smooth, load):
    rng = random.Random(1)
    for parts in combinations(hysteresis=hysteresis, smooth=smooth, load=load):
        model = parts.build()
        for _ in range(2):
            point = random_point(model, rng)
            x, u, p = point.of(model)
            terms = equations.rates(parts, point.q, point.x, point.u)
            found = dict(zip(model.state_names, model.derivative(x, u, p), strict=True))
            assert set(found) == set(terms)
            for name, value in found.items():
                assert_sum(value, terms[name], f"{parts}: d{name}/dt")
            outputs = dict(zip(model.output_names, model.evaluate_output(x, u, p), strict=True))
            for name in set(outputs) - {"torque"}:
                assert outputs[name] == point.x[name]
            assert ("torque" in outputs) == (load != "measured")
            if load != "measured":
                acceleration = sum(terms["omega"])
                reading = equations.sensor_reading(parts, point.q, point.x, point.u, acceleration)
                inertia = equations.total_inertia(parts, point.q)
                # The acceleration's own terms cancel too.
                assert_sum(
                    outputs["torque"],
                    reading,
                    f"{parts}: torque",
                    inertia * sum(map(abs, terms["omega"])),
                )


def assert_sum(value, terms, what, further=0.0):
    """Terms cancel: what is left is judged by the size of what it is made of."""
    size = sum(abs(term) for term in terms) + further
    assert abs(value - sum(terms)) <= 1e-13 * size, f"{what}: {value} and not {sum(terms)}"


def test_there_are_as_many_combinations_as_the_choices_say():
    assert len(ALL) == len(set(ALL)) == 2 * 2 * 5 * 2 * 3 * (6 * 2 - 1) * 2


def test_at_rest_nothing_moves_but_a_mass_that_falls_onto_its_cable():
    for parts in ALL:
        model = parts.build()
        u, p = (0.0,) * len(model.inputs), tuple(model.nominal)
        slopes = model.derivative(tuple(model.initial_state), u, p)
        np.testing.assert_allclose(slopes, 0.0, atol=1e-9, err_msg=str(parts))


@pytest.mark.parametrize("name", ["nominal", "rig", "A", "B", "C", "D"])
def test_every_combination_takes_every_named_set(name):
    for motor, brake, (hysteresis, exponent), friction in itertools.product(
        ("closed", "open"), ("closed", "open"), HYSTERESES, ("none", "cyclic")
    ):
        model = actuator(
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
