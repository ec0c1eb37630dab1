"""What the actuator's logs tell before a search: the truth must be within it."""

from __future__ import annotations

import numpy as np
import pytest

from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset, SearchSpace, guess_ranges
from tests.sysid.support import draw

# Noise of the simulated rig's currents [A], and a speed and a torque as an encoder and a bridge
# give them [rad/s], [N*m].
NOISE, TORQUE_NOISE = (0.005, 0.005, 0.02), 0.007


def record(model, vector, seed, kind="prbs", rate=800, n=1000):
    """A noisy log under PRBS, or under levels held long enough for the speed to settle."""
    rng = np.random.default_rng(seed)
    holds = (0.005, 0.05) if kind == "prbs" else (0.3, 1.5)
    levels = ([-0.65, 0.85], [0.0, 0.14]) if kind == "prbs" else ([-1.2, -0.4, 0.5, 1.4], [0, 0.03])
    commands = [
        np.repeat(rng.choice(level, n), round(hold * rate))[:n]
        for level, hold in zip(levels, holds, strict=True)
    ]
    load = 0.02 * np.sin(2 * np.pi * 0.7 * np.arange(n) / rate + seed)
    true = Dataset(np.column_stack([*commands, load]), np.full((n, 3), np.nan), 1 / rate)
    outputs = BatchSimulator(model).trajectories(vector, true)[0]
    return Dataset(
        np.column_stack([*commands, load + TORQUE_NOISE * rng.normal(size=n)]),
        outputs + NOISE * rng.normal(size=(n, 3)), 1 / rate, f"{kind}-{seed}",
    )  # fmt: skip


def some(model, n, seed):
    """Feasible parameters drawn from the model's ranges."""
    vectors = draw(model, np.random.default_rng(seed), 40 * n)
    space = SearchSpace.of(model)
    feasible = np.all(space.violations(vectors[:, list(space.index)]) <= 0.0, axis=1)
    return vectors[feasible][:n]


def check(model, vector, found):
    for name, guess in found.items():
        true = vector[model.parameter_names.index(name)]
        assert guess.low <= true <= guess.high, (name, true, guess)
        parameter = model.parameter(name)
        assert guess.low > parameter.lower or guess.high < parameter.upper


@pytest.mark.soak
@pytest.mark.parametrize("drivers", [("closed", "closed"), ("open", "open")])
def test_the_truth_is_within_whatever_is_told(drivers):
    model = actuator(driver_motor=drivers[0], driver_brake=drivers[1])
    told = set()
    for seed, vector in enumerate(some(model, 3, 1)):
        for kind, n in (("prbs", 1000), ("steps", 2000)):
            log = record(model, vector, seed, kind, n=n)
            if not np.isfinite(log.outputs).all():
                continue  # drawn where the current's loop is unstable
            found = guess_ranges(model, [log])
            check(model, vector, found)
            told |= set(found)
    gains = {
        f"{'K' if kind == 'closed' else 'G'}_d{s}" for s, kind in zip("mb", drivers, strict=True)
    }
    assert told >= {*gains, "R_m", "K_m"}


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["bouc-wen", "lugre"])
def test_the_rigs_own_values_are_within_it(kind):
    model = actuator(hysteresis=kind, parameters="rig")
    for seed in range(2):
        logs = [
            record(model, model.nominal, seed),
            record(model, model.nominal, seed, "steps", n=2500),
        ]
        found = guess_ranges(model, logs)
        check(model, model.nominal, found)
        assert {"K_dm", "R_m"} <= set(found)
        assert "in 2 logs" in found["K_dm"].source
        with_constant = guess_ranges(model, logs, fixed={"K_m": model.parameter("K_m").nominal})
        check(model, model.nominal, with_constant)
        assert "moments of steady speed in" in with_constant["c0"].source


def test_a_resistance_from_a_data_sheet_tells_gain_and_motor_constant():
    """Only their ratio to the resistance is in the current."""
    model = actuator(parameters="rig")
    log = record(model, model.nominal, 0, n=2000)
    loose = guess_ranges(model, [log])
    tight = guess_ranges(model, [log], fixed={"R_m": 1.18})
    check(model, model.nominal, loose)
    check(model, model.nominal, tight)
    assert "R_m" not in tight
    assert tight["K_dm"].high / tight["K_dm"].low < 3.0 < loose["K_dm"].high / loose["K_dm"].low
    assert tight["K_m"].high / tight["K_m"].low < 3.0
    assert "R_m 1.18" in tight["K_dm"].source and "K_v2i 0.5" in tight["K_dm"].source


@pytest.mark.soak
def test_an_output_resistance_shares_what_is_told_of_both():
    model = actuator(
        order_motor=2, output_resistance_motor=True, output_resistance_brake=True, parameters="rig"
    )
    log = record(model, model.nominal, 0, n=2000)
    loose = guess_ranges(model, [log])
    check(model, model.nominal, loose)
    assert "R_m + R_om" in loose["K_dm"].source
    assert set(loose) <= set(model.parameter_names)
    plain = guess_ranges(model, [log], fixed={"R_m": 1.18})
    assert "R_m + R_om in 1.19 .. 2.18" in plain["K_dm"].source


@pytest.mark.soak
def test_a_fast_log_tells_the_cutoff_and_the_inductance_of_an_open_driver():
    model = actuator(driver_motor="open", driver_brake="open", parameters="rig")
    found = guess_ranges(model, [record(model, model.nominal, 0, rate=8000, n=8000)])
    check(model, model.nominal, found)
    # 1/omega + L/R is 1.55 ms, so that the cutoff is at least 646 rad/s.
    assert 400.0 < found["omega_dm"].low < 646.0
    assert "mean delay of current_motor" in found["omega_dm"].source


@pytest.mark.soak
def test_theta_serves_in_place_of_omega_and_without_either_the_motor_is_left_alone():
    model = actuator(parameters="rig", outputs=("current_motor", "current_brake", "theta"))
    found = guess_ranges(model, [record(model, model.nominal, 1, n=2000)])
    assert {"K_dm", "R_m"} <= set(found)
    currents = model.with_outputs(["current_motor", "current_brake"])
    log = record(model, model.nominal, 1, n=2000)
    alone = Dataset(log.inputs, log.outputs[:, :2], log.dt)
    assert not {"K_dm", "R_m", "K_m", "c0"} & set(guess_ranges(currents, [alone]))


@pytest.mark.soak
def test_brush_friction_leaves_the_damping_alone():
    """Its torque falls with the speed, so that the slope is no limit."""
    model = actuator(parameters="rig", friction="cyclic")
    log = record(model, model.nominal, 0, "steps", n=2500)
    found = guess_ranges(model, [log])
    assert found and not {"c0", "c1", "B_m"} & set(found)


def test_a_still_or_empty_log_tells_nothing():
    model = actuator(parameters="rig")
    still = Dataset(np.zeros((500, 3)), np.zeros((500, 3)), 1 / 800)
    assert guess_ranges(model, [still]) == {}
    blank = Dataset(np.ones((500, 3)), np.full((500, 3), np.nan), 1 / 800)
    assert guess_ranges(model, [blank]) == {}
    short = record(model, model.nominal, 0, n=10)
    assert guess_ranges(model, [short]) == {}


@pytest.mark.soak
def test_lost_samples_do_not_mislead():
    """A gap in the speed is unknown, not zero, also for the samples that follow it."""
    model = actuator(driver_motor="open", driver_brake="open", parameters="rig")
    log = record(model, model.nominal, 2, n=6000)
    whole = guess_ranges(model, [log], fixed={"R_m": 1.18})["K_m"]
    for begin in range(30, 6000, 60):
        log.outputs[begin : begin + 25, 2] = np.nan
    found = guess_ranges(model, [log], fixed={"R_m": 1.18})
    check(model, model.nominal, found)
    assert found["K_m"].low + found["K_m"].high == pytest.approx(whole.low + whole.high, rel=0.015)
