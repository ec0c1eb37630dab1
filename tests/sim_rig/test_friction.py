"""Dry friction of the brushes: its curve, its loss, its turn, its constraints."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_rig.physics.friction import FRICTIONS
from tests.sim_rig.support import Parts

STRIBECK = {"F_c": 0.02, "F_s": 0.03, "omega_s": 2.0, "B_f": 1e-3, "omega_r": 0.01}
CYCLIC = STRIBECK | {"F_cos": 0.008, "F_sin": -0.006, "cycles": 3.0}
VALUES = {"stribeck": STRIBECK, "cyclic": CYCLIC}


def torque(kind, theta, omega, **changes):
    rubbing = FRICTIONS[kind]
    values = VALUES[kind] | changes
    assert [parameter.name for parameter in rubbing.parameters] == list(values)
    return rubbing.torque(theta, omega, tuple(values.values()))


def test_friction_by_hand():
    omega = 0.02  # two omega_r, a hundredth of omega_s
    level = 0.02 + 0.01 * math.exp(-1e-4)
    expected = level * math.tanh(2.0) + 2e-5
    assert torque("stribeck", 1.2, omega) == pytest.approx(expected, rel=1e-12)
    around = 0.008 * math.cos(3.6) - 0.006 * math.sin(3.6)
    expected += around * math.tanh(2.0)
    assert torque("cyclic", 1.2, omega) == pytest.approx(expected, rel=1e-12)
    assert FRICTIONS["none"].parameters == ()
    assert FRICTIONS["none"].torque(1.2, omega, ()) == 0.0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_it_breaks_away_at_one_level_and_runs_at_another(direction):
    """Stribeck: F_s while slower than omega_s, F_c and the viscous part while faster."""
    slow, fast = direction * 0.1, direction * 20.0
    assert torque("stribeck", 0.0, slow, B_f=0.0) == pytest.approx(direction * 0.03, rel=2e-3)
    assert torque("stribeck", 0.0, fast, B_f=0.0) == pytest.approx(direction * 0.02, rel=1e-9)
    assert torque("stribeck", 0.0, fast) == pytest.approx(direction * (0.02 + 0.02), rel=1e-9)
    # In between it falls with speed, and at omega_s a part 1/e of the difference is left.
    curve = [abs(torque("stribeck", 0.0, direction * v, B_f=0.0)) for v in (0.1, 0.5, 1, 2, 3, 6)]
    assert curve == sorted(curve, reverse=True)
    assert curve[3] == pytest.approx(0.02 + 0.01 / math.e, rel=1e-9)


def test_its_sign_is_smooth_within_omega_r():
    """Below it the shaft creeps: the torque is proportional to the speed."""
    slopes = [torque("stribeck", 0.0, v, B_f=0.0) / v for v in (1e-6, 1e-5, 1e-4)]
    np.testing.assert_allclose(slopes, 0.03 / 0.01, rtol=1e-3)
    assert torque("stribeck", 0.0, 0.0) == 0.0


@pytest.mark.parametrize("kind", ["stribeck", "cyclic"])
@pytest.mark.parametrize("omega", [0.05, -0.3, 4.0])
def test_it_approaches_the_sign_of_the_speed_as_omega_r_falls(kind, omega):
    level = 0.02 + 0.01 * math.exp(-((omega / 2.0) ** 2))
    if kind == "cyclic":
        level += 0.008 * math.cos(2.1) - 0.006 * math.sin(2.1)
    coulomb = math.copysign(level, omega) + 1e-3 * omega
    widths = [abs(omega) * share for share in (3.0, 1.0, 0.3, 0.1, 0.03)]
    distances = [abs(torque(kind, 0.7, omega, omega_r=width) - coulomb) for width in widths]
    assert all(after < before for before, after in pairwise(distances))
    assert distances[-1] < 1e-12


@given(
    theta=st.floats(-50.0, 50.0),
    omega=st.floats(-30.0, 30.0),
    F_c=st.floats(1e-3, 0.2),
    more=st.floats(1.0, 3.0),
    worn=st.floats(0.0, 1.0),
    phase=st.floats(-math.pi, math.pi),
)
def test_within_its_constraints_it_never_drives(theta, omega, F_c, more, worn, phase):
    worn *= F_c * (1.0 - 1e-9)
    values = {
        "F_c": F_c, "F_s": more * F_c,
        "F_cos": worn * math.cos(phase), "F_sin": worn * math.sin(phase),
    }  # fmt: skip
    assert torque("cyclic", theta, omega, **values) * omega >= 0.0
    model = Parts(friction="cyclic").build()
    row = tuple(model.vector(values))
    assert all(constraint.function(row) <= 1e-15 for constraint in model.constraints)


@pytest.mark.parametrize("cycles", [1.0, 2.0, 5.0])
def test_the_cyclic_part_has_its_periods_in_a_turn(cycles):
    angle = 2.0 * math.pi * np.arange(64) / 64
    found = np.array([torque("cyclic", a, 1.0, cycles=cycles) for a in angle])
    spectrum = np.fft.rfft(found) / 32
    amplitude = np.abs(spectrum)
    assert amplitude[int(cycles)] == pytest.approx(math.hypot(0.008, 0.006), rel=1e-9)
    # Cosine and sine where they belong, and nothing at the other harmonics.
    assert spectrum[int(cycles)] == pytest.approx(0.008 + 0.006j, rel=1e-9)
    others = np.delete(amplitude, [0, int(cycles)])
    np.testing.assert_allclose(others, 0.0, atol=1e-15)
    plain = torque("stribeck", 0.0, 1.0)
    assert amplitude[0] / 2.0 == pytest.approx(plain, rel=1e-9)
    # Against the motion whichever way it goes.
    for a in angle[::7]:
        assert torque("cyclic", a, -1.0) == pytest.approx(-torque("cyclic", a, 1.0), rel=1e-12)


@pytest.mark.parametrize(
    ("text", "changes", "size"),
    [
        ("F_s >= F_c", {"F_c": 0.03, "F_s": 0.029}, 1e-3),
        ("F_s >= F_c", {"F_c": 0.03, "F_s": 0.031}, -1e-3),
        ("F_c >= (F_cos", {"F_c": 0.05, "F_s": 0.06, "F_cos": 0.03, "F_sin": -0.0401}, 8e-5),
        ("F_c >= (F_cos", {"F_c": 0.05, "F_s": 0.06, "F_cos": -0.03, "F_sin": 0.0399}, -8e-5),
    ],
)
def test_constraints_are_violated_by_how_much_they_are(text, changes, size):
    model = Parts(friction="cyclic").build()
    (constraint,) = [c for c in model.constraints if c.text.startswith(text)]
    row = model.vector(changes)
    assert constraint.function(tuple(row)) == pytest.approx(size, rel=0.01)
    rows = np.array([row, model.nominal])
    np.testing.assert_array_equal(
        constraint.function(tuple(rows.T)), [constraint.function(tuple(r)) for r in rows]
    )


def test_only_what_there_is_is_constrained():
    texts = {
        kind: [c.text[:10] for c in Parts(friction=kind).build().constraints if c.text[0] == "F"]
        for kind in ("none", "stribeck", "cyclic")
    }
    assert texts == {"none": [], "stribeck": ["F_s >= F_c"], "cyclic": ["F_s >= F_c", "F_c >= (F_"]}
