"""What no residual shows and moves parameters all the same is said, and only where it does."""

import re

import numpy as np
import pytest

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.gassi import GASSI
from sysid.judging.examination import verdict_of
from tests.soak import mostly_soak
from tests.sysid.support import held_lag

INERTIA, VISCOUS, DRY, DT, N = 0.02, 0.006, 0.03, 0.01, 1500
INERTIA_RANGE = Parameter("J", "kg*m^2", 0.034, 0.002, 0.2, "log")
VISCOUS_RANGE = Parameter("B", "N*m*s/rad", 0.01, 6e-4, 0.06, "log")


def rotor(derivative, *parameters):
    return ProcessModel(
        name="rotor",
        states=(State("w", "rad/s", initial_range=(-200.0, 300.0)),),
        inputs=(Input("T", "N*m"),),
        outputs=(Output("w", "rad/s"),),
        parameters=(INERTIA_RANGE, VISCOUS_RANGE, *parameters),
        derivative=derivative,
    )


SMOOTH = rotor(lambda x, u, p: ((u[0] - p[1] * x[0]) / p[0],))
RUBBING = rotor(
    lambda x, u, p: ((u[0] - p[1] * x[0] - p[2] * (1.0 if x[0] > 0.0 else -1.0)) / p[0],),
    Parameter("Tc", "N*m", 0.02, 0.001, 0.2, "log"),
)


def record(seed, place, dry, least=0.6):
    """A rotor under levels of torque, from least to 1 N*m, with noise of 1 rad/s; exact."""
    rng = np.random.default_rng([seed, place])
    lengths = rng.integers(20, 120, N // 20)
    torque = np.repeat(rng.uniform(least, 1.0, len(lengths)), lengths)[:N]
    pole, w, y = np.exp(-VISCOUS / INERTIA * DT), (max(least, 0.0) + 0.2 - dry) / VISCOUS, []
    for k in range(N):
        y.append(w)
        for _ in range(10):  # within which it may turn round
            part = pole**0.1
            w = part * w + (1.0 - part) * (torque[k] - dry * np.sign(w)) / VISCOUS
    return Dataset(torque, np.array(y) + rng.standard_normal(N), DT, f"place {place}")


def verdict_on(model, seed, *options):
    records = [record(seed, place, *options) for place in (1, 2)]
    fitted = GASSI(model, population=60, generations=14, random_state=seed).fit(records[0])
    return verdict_of(fitted, records[:1], records[1:])


def blind_spots(verdict):
    return [note for note in verdict.notes if "would not show" in note]


@pytest.mark.parametrize(("seed", "dry"), mostly_soak([(0, DRY), (0, 0.0), (3, DRY)], always=2))
def test_friction_that_one_way_hides_is_said_with_what_it_would_move(seed, dry):
    """4 % of the torque, and B is off by 60 half widths; whether it is there nothing tells."""
    (note,) = blind_spots(verdict_on(SMOOTH, seed, dry))
    assert note.startswith("These data would not show dry friction of w of up to ")
    assert "mN*m. That would move B by " in note
    assert note.endswith("w never turns round in them: a record that moves both ways tells.")


def test_what_moves_both_ways_hides_no_friction():
    verdict = verdict_on(SMOOTH, 0, 0.0, -1.0)
    assert verdict.trust == "good", verdict.reasons
    assert not blind_spots(verdict)


def test_friction_that_the_model_has_is_not_missing():
    """What it may be by data of one way its own interval says."""
    notes = " ".join(blind_spots(verdict_on(RUBBING, 0, DRY)))
    assert "dry friction" not in notes


WINDING = ProcessModel(
    name="winding",
    states=(State("i", "A"),),
    inputs=(Input("V", "V"),),
    outputs=(Output("i", "A"),),
    parameters=(
        Parameter("R", "ohm", 1.5, 0.2, 20.0, "log"),
        Parameter("L", "H", 2e-3, 1e-4, 1e-2, "log"),
    ),
    derivative=lambda x, u, p: ((u[0] - p[0] * x[0]) / p[1],),
)


def switched(seed, place, late, crosstalk=0.0, n=2000, dt=1e-3):
    """Current of a winding of 2.3 ohm and 1.1 mH whose voltage acts so many samples late.

    crosstalk: of the voltage in what is logged of the current [A/V].
    """
    rng = np.random.default_rng([seed, place])
    lengths = rng.integers(10, 60, n // 10)
    levels = np.repeat(rng.uniform(-12.0, 12.0, len(lengths)), lengths)[:n]
    # Nothing acts before the first of them.
    i = held_lag(np.append(0.0, levels), -late, 1.0 / 2.3, 1.1e-3 / 2.3 / dt)[1:]
    i += crosstalk * levels + 0.02 * rng.standard_normal(n)
    return Dataset(levels, i, dt, f"place {place}")


def verdict_on_winding(*wrong):
    records = [switched(0, place, *wrong) for place in (1, 2)]
    fitted = GASSI(WINDING, population=60, generations=14, random_state=0).fit(records[0])
    return verdict_of(fitted, records[:1], records[1:])


@pytest.mark.parametrize("late", [0.0, 0.03])
def test_a_driver_that_takes_its_time_looks_like_another_inductance(late):
    """30 us late at 1 kHz, and L is 3 % off: three half widths."""
    (note,) = blind_spots(verdict_on_winding(late))
    assert note.startswith("These data would not show that V acts up to ")
    assert " s later than it is logged. That would move L by " in note.replace("µs", "s")


def test_a_sensor_that_sees_the_voltage_is_named_with_how_much_of_it():
    """1 % of a voltage of 12 V, and R is 2 % off; a delay of 15 us looks nearly the same."""
    verdict = verdict_on_winding(0.0, 0.01)
    assert verdict.parameters.trust == "limited"
    size = re.search(r"V stands in i as well, ([\d.]+) A/V of it", verdict.parameters.reasons[0])
    assert size is not None, verdict.parameters.reasons
    assert float(size[1]) == pytest.approx(0.01, rel=0.25)
    assert " R 2.2" in verdict.parameters.reasons[0]
