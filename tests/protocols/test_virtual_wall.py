"""Virtual walls: the theory against a simulated loop, runs on both sides of it, what is refused."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.signal import cont2discrete

from daq.config.rig import RigConfig
from daq.errors import ConfigError, RunError
from daq.experiment import Sample
from daq.run.plan import plan
from protocols.analysis.walls import SampledWall
from protocols.control.loop import SpeedTracker
from protocols.virtual_wall import VirtualWall
from sim_rig.backend import Simulation
from sim_rig.device.user import SimulatedUser
from tests.protocols.closed_loop import logged, numbers, run, shipped
from tests.soak import mostly_soak

PERIOD = 1.0 / 800.0
HELD = {"load": "hand"}
LEANS = [[0.5, 1.0]]


def wall(**changes):
    return shipped("virtual_wall.yaml", VirtualWall, **{"calibration": {"samples": 400}, **changes})


def swing(loop, stiffness, damping, n=6000):
    """Angles of a shaft against a two-sided wall, by another discretisation than the theory's."""
    a = np.array([[0.0, 1.0], [-loop.stiffness / loop.inertia, -loop.damping / loop.inertia]])
    b = np.array([[0.0], [1.0 / loop.inertia]])
    ad, bd, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), loop.period)
    tracker, x = SpeedTracker(loop.bandwidth), np.array([1e-3, 0.0])
    tracker.update(-loop.period, 1e-3)
    waiting, angles = [0.0] * loop.ahead, []
    for k in range(n):
        speed = tracker.update(k * loop.period, x[0])
        waiting.append(-stiffness * x[0] - damping * speed)
        x = ad @ x + bd[:, 0] * waiting.pop(0)
        angles.append(x[0])
        if abs(x[0]) > 1e3:
            break
    return np.abs(angles)


@pytest.mark.parametrize("ahead", [1, 2, 4])
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_a_wall_rings_just_beyond_the_critical_stiffness(ahead, damping):
    loop = SampledWall(1e-4, 0.018, 0.16, PERIOD, ahead, 150.0)
    critical = loop.critical_stiffness(damping)
    decays, grows = (swing(loop, part * critical, damping) for part in (0.97, 1.03))
    assert decays[-400:].max() < 0.5 * decays[:400].max()
    assert grows[-400:].max() > 2.0 * grows[:400].max()


@pytest.mark.parametrize("ahead", [1, 2])
def test_the_critical_stiffness_is_that_of_a_delayed_spring(ahead):
    # For a slow wall K (T/2 + delay) < b (Hulin, Preusche & Hirzinger 2006).
    loop = SampledWall(0.1, 0.01, 0.0, PERIOD, ahead, 1e4)
    expected = 0.01 / (PERIOD / 2.0 + ahead * PERIOD)
    assert loop.critical_stiffness(0.0) == pytest.approx(expected, rel=0.01)


def test_the_passive_stiffness_is_that_of_the_bound():
    theory = wall().theory
    physical = theory.damping(0.0)
    for damping in (0.0, 0.005, -0.01):
        passive = theory.passive_stiffness(0.0, damping)
        assert passive * PERIOD / 2.0 + abs(damping) == pytest.approx(physical)
    assert theory.passive_stiffness(0.0, physical + 0.002) < 0.0


def test_a_wall_that_rings_at_any_stiffness_has_no_critical_one():
    assert SampledWall(1e-4, 2e-4, 0.0, PERIOD, 1, 150.0).critical_stiffness(0.2) == 0.0


@pytest.mark.parametrize("damping", mostly_soak([0.0, 0.02]))
def test_on_the_simulated_rig_walls_ring_on_the_side_that_theory_says(tmp_path, damping):
    critical = wall().theory.loop(0.0, hand=True).critical_stiffness(damping)
    walls = [0.6 * critical, 0.85 * critical, 1.2 * critical, 1.4 * critical]
    settings = wall(stiffnesses=walls, dampings=[damping], brake_commands=[0])
    samples, extra = run(settings, tmp_path, HELD, hand=LEANS)
    found = settings.findings(samples, extra)
    (table,) = (table for table in found.tables if table.name == "walls")
    assert table.columns["stable"].tolist() == [1.0, 1.0, 0.0], "the stiffest was passed over"
    assert numbers(found)["stiffest"].value == walls[1]
    assert any("not visited" in remark and remark.endswith(": 1.") for remark in found.remarks)
    assert not (extra["cell"] == 3).any()
    assert np.abs(samples.cmd_voltage_motor).max() <= settings.motor_limit
    limit = settings.ringing.speed
    assert np.abs(samples.omega[-200:]).max() < 0.2 * limit, "calm in the soft wall again"


def test_the_wall_pushes_back_by_its_law_and_only_inside(tmp_path):
    settings = wall(stiffnesses=[5], dampings=[0.01], brake_commands=[0.02], tap={"torque": 0})
    samples, extra = run(settings, tmp_path, HELD, ideal=True, hand=LEANS)
    inside = extra["penetration"] > 0.0
    assert inside.any() and not inside.all()
    commands = samples.cmd_voltage_motor[1:]
    assert not commands[~inside[:-1]].any()
    calm = inside & (np.abs(samples.omega) < 0.02)
    expected = -extra["stiffness"] * extra["penetration"] / settings.motor_gain
    np.testing.assert_allclose(commands[calm[:-1]], expected[:-1][calm[:-1]], atol=0.02)
    rows = (extra["state"] == 2.0) & inside
    assert (extra["stiffness"][rows] == 5.0).all() and (extra["damping"][rows] == 0.01).all()
    assert (samples.cmd_voltage_brake[1:][rows[:-1]] == 0.02).all()


def test_nobody_at_the_handle_ends_the_run(tmp_path):
    with pytest.raises(RunError, match="nobody leant against the wall"):
        run(wall(patience=1), tmp_path, HELD)
    (folder,) = tmp_path.iterdir()
    with pytest.raises(ValueError, match="did a hand lean"):
        wall(patience=1).findings(*logged(wall(patience=1), folder))


def feed(settings, depths):
    """Answers and logged columns for a shaft that moves as given, whatever is commanded."""
    controller = settings.controller()
    rows = []
    for k, depth in enumerate([-settings.position, *depths]):
        answer = controller.answer(Sample(k, k * PERIOD, 0.0, 0.0, 0.0, depth, 0.0, 0))
        if answer is None:
            break
        rows.append(answer)
    return rows


def test_a_cell_is_left_at_once_when_the_shaft_gets_too_fast():
    settings = wall(stiffnesses=[5, 6], dampings=[0.0, 0.01], brake_commands=[0], position=0.0)
    depths = np.full(2400, 0.05)
    times = np.arange(2400) * PERIOD
    # In contact after 0.5 s, resting until 0.9 s; a throw in the first cell.
    depths += np.where((times > 1.0) & (times < 1.05), 0.05 * np.sin(400.0 * (times - 1.0)), 0.0)
    rows = feed(settings, depths)
    state, cell = (np.array([row.logged[i] for row in rows]) for i in (1, 0))
    (left,) = np.flatnonzero(state == 3.0)
    assert 1.0 < left * PERIOD < 1.05 and cell[left] == 0.0
    assert cell[left + 1] == 2.0, "the stiffer one of the same damping is passed over"
    assert rows[left + 1].logged[2] == settings.rest.stiffness


def test_a_wall_out_of_contact_is_not_stable():
    settings = wall(stiffnesses=[5], dampings=[0.0], brake_commands=[0], position=0.0)
    depths = np.interp(np.arange(2400) * PERIOD, [1.0, 1.2], [0.05, -0.05])
    rows = feed(settings, depths)
    extra = dict(zip(settings.columns, np.array([row.logged for row in rows]).T, strict=True))
    samples = type("S", (), {"time": np.arange(len(rows)) * PERIOD})
    found = settings.findings(samples, extra)
    assert numbers(found)["stiffest"].value == 0.0
    assert any("without contact" in remark for remark in found.remarks)


def test_the_plan_says_what_is_passive_before_anything_moves():
    settings = wall(
        stiffnesses=[1, 2, 4], dampings=[0, 0.001], brake_commands=[0, 0.1],
        body={"damping": 0.002, "brake_damping": 0.01},
    )  # fmt: skip
    without, with_brake, warning = plan(settings, RigConfig()).remarks
    assert "hold the handle firmly" in warning and "hand.yaml" in warning
    # 2 (b - B) / T: 3.2 and 1.6 N*m/rad without the brake, 4.8 and 3.2 with its 0.001 more.
    assert "(1.1)" in without and "K = 3.2 N*m/rad" in without and "3 of the 6" in without
    drawn = settings.preview()
    walls, held, free, passive = drawn.series
    assert len(walls.x) == 6 and walls.style == "points"
    assert (held.y >= free.y)[np.isfinite(held.y)].all() and passive.y[0] == pytest.approx(3.2)
    assert "(1.2)" in with_brake and "K = 4.8 N*m/rad" in with_brake and "5 of the 6" in with_brake


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stiffnesses": [2, 1]}, "stiffnesses: write them rising"),
        ({"brake_commands": [0.5]}, "brake: the plan asks"),
        ({"ringing": {"watch": 0.01}}, "ringing.watch: 0.01 s is less than 40 samples"),
        ({"tap": {"time": 1e-6}}, "tap.time: 1e-06 s is less than 1 samples"),
    ],
)
def test_what_cannot_be_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        plan(wall(**changes), RigConfig())


# The hand of the simulated rig.


def test_the_hand_moves_through_its_points_from_the_start_of_the_run():
    user = SimulatedUser(True, [(1.0, 0.5), (2.0, 0.5), (4.0, -0.5)])
    assert user.motion(np.array([3.0]))[0].tolist() == [1.0, 0.0, 0.0]
    user.stop()
    user.move(10.0)
    times = 10.0 + np.array([0.0, 0.5, 1.5, 3.0, 9.0])
    grip, angle, speed = user.motion(times).T
    assert grip.tolist() == [1.0] * 5
    assert angle.tolist() == [0.0, 0.25, 0.5, 0.0, -0.5]
    assert speed.tolist() == [0.5, 0.5, 0.0, -0.5, 0.0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hand": [[1, 1]]}, "the load is 'pulley'"),
        ({"plant": HELD, "hand": [[1, 1], [1, 2]]}, "times above 0 that rise"),
        ({"plant": HELD, "hand": [[0, 1]]}, "times above 0 that rise"),
    ],
)
def test_a_hand_that_cannot_be_is_refused(options, message):
    with pytest.raises(ValidationError, match=message):
        Simulation.model_validate(options)
