"""Velocity loops among the runs of a design: within the frame, as the rig plays them, in limits."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from daq import record
from daq.config.yaml_file import TypedSettings
from daq.designs.bench import COMMANDED, PlantBench
from daq.designs.setup import set_up
from daq.experiment import RunFrame, Shaft
from daq.lookup.classes import find_class
from daq.lookup.rigs import load_rig
from protocols.control.staircase import Plateau, SettlingTest, longest, quickest
from sim_rig.actuator import actuator
from tests.daq.support import record_of, rig, write_yaml

SHAFT = Shaft(150.0, True, "between", None)
FRAME = RunFrame(2000, 800.0, (-5.0, 5.0), (0.0, 0.38), SHAFT)
MODEL = "actuator:load=free,sensor=between"
TURNING = {
    "velocity_0": 20.0, "velocity_1": -15.0, "velocity_2": 40.0, "brake": 0.02, "ramps": 0.2,
    "motor_limit": 2.0, "stiffness": 4.0, "integral_time": 0.04,
}  # fmt: skip
LOOPS = ["constant_velocity", "hysteresis_loop"]
MISTAKE = "it answered 'full steam'"


def family(name, frame=FRAME):
    return find_class("protocol", name, None).family(frame)


def drawn(free, genes):
    """Values of free settings at places in their ranges."""
    values = {}
    for (name, each), gene in zip(free.items(), genes, strict=True):
        value = (
            each.low * (each.high / each.low) ** gene
            if each.log
            else each.low + (each.high - each.low) * gene
        )
        values[name] = round(value) if each.whole else value
    return values


@pytest.mark.parametrize("name", LOOPS)
@given(genes=st.lists(st.floats(0.0, 1.0), min_size=8, max_size=8), n=st.integers(1500, 16_000))
def test_all_of_a_family_are_runs_that_end_within_the_frame(name, genes, n):
    frame = replace(FRAME, n_samples=n)
    offered = family(name, frame)
    content = offered.content(drawn(offered.free, genes[: len(offered.free)]))
    experiment = find_class("protocol", name, None).model_validate(
        {"protocol": name, "sample_rate": 800, **content}
    )
    planned = experiment.plan()
    assert 0.95 * n <= planned.n_samples <= n
    assert np.all(planned.lowest >= [-5.0, 0.0]) and np.all(planned.highest <= [5.0, 0.38])
    assert np.abs(planned.references["omega_ref"]).max() <= 0.6 * SHAFT.speed + 1e-9


@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_is_offered_only_where_the_rig_allows_it(name):
    assert family(name) is not None
    for shaft in (None, Shaft(150.0, True, "load", None)):
        assert family(name, replace(FRAME, shaft=shaft)) is None
    assert family(name, replace(FRAME, shaft=Shaft(150.0, True, "load", 0.14))) is not None
    assert family(name, replace(FRAME, motor=(0.0, 5.0))) is None
    wound = Shaft(150.0, False, "between", None)
    assert (family(name, replace(FRAME, shaft=wound)) is None) == (name == "constant_velocity")


@given(
    velocities=st.lists(st.floats(1.0, 100.0), min_size=1, max_size=4),
    brakes=st.lists(st.floats(0.0, 0.38), min_size=1, max_size=3),
    slope=st.floats(10.0, 1000.0),
)
def test_no_staircase_that_settles_at_once_takes_longer_than_the_longest(velocities, brakes, slope):
    plateaus = [Plateau(v, b, 0.1) for b in brakes for v in velocities]
    settling = SettlingTest(time=0.0, timeout=0.05)
    seconds = longest(plateaus, settling, slope)
    assert len(quickest(plateaus, settling, slope, 1e4)[0]) <= 1e4 * seconds + len(plateaus) + 1


@pytest.fixture(scope="module")
def free_shaft():
    asked = {"rig": "free_shaft.yaml", "model": MODEL, "sample_rate": "800 Hz"}
    return set_up(TypedSettings.of(asked | {"time": "2.5 s", "run": "2.5 s"}, [], None))


@pytest.mark.soak
def test_what_the_model_is_given_of_a_loop_is_what_the_rig_would_log(tmp_path, free_shaft):
    config, device = load_rig("free_shaft.yaml", {"ideal": True})
    model = actuator(load="free", sensor="between", parameters="rig")
    # An ideal rig tells angles, not counts.
    encoder = config.sensors.encoder.model_copy(update={"cycles": 1_000_000})
    sensors = config.sensors.model_copy(update={"encoder": encoder})
    config = config.model_copy(update={"sensors": sensors})
    bench = PlantBench(model, device.plant_model(0.0), config)
    offered = free_shaft.families["constant_velocity"]
    (simulated,) = bench.records(offered.commands(TURNING), 1.0 / 800.0, model.nominal[None])
    write_yaml(tmp_path / "turning.yaml", offered.content(TURNING))
    write_yaml(
        tmp_path / "rig.yaml",
        {
            "backend": "simulated",
            "options": {"ideal": True, "plant": {"load": "free", "sensor": "between"}},
            "sensors": {"torque": {"scale": 0.706}},
        },
    )
    log = record(tmp_path / "turning.yaml", rig=tmp_path / "rig.yaml", out=tmp_path).frame
    assert abs(len(log) - simulated.n_samples) <= 2
    n = min(len(log), simulated.n_samples)
    applied = log[["applied_voltage_motor", "applied_voltage_brake"]].to_numpy()[:n]
    assert np.abs(simulated.inputs[:n, :2] - applied).max() < 0.02
    signals = bench.signals(offered.commands(TURNING), 1.0 / 800.0, model.nominal[None])
    assert np.abs(signals["omega"][0, :n] - log["omega"].to_numpy()[:n]).max() < 0.5
    assert signals["omega"].shape == signals[COMMANDED[0]].shape == (1, 1998)
    assert not signals[COMMANDED[0]][0, len(log) + 2 :].any()


@pytest.mark.parametrize(
    ("limits", "settings"),
    [
        ({"speed": 43.0}, {}),  # 40 rad/s and a margin of a tenth
        ({"current": {"motor": 0.05}}, {}),
        ({"slew": {"motor": 1.0}}, {}),
        ({}, {"stiffness": 400.0, "motor_limit": 4.4}),  # rings: the protocol itself would stop it
    ],
)
def test_a_loop_that_would_pass_a_limit_is_refused(free_shaft, limits, settings):
    config, device = load_rig("free_shaft.yaml")
    model = actuator(load="free", sensor="between", parameters="rig")
    feedback = free_shaft.families["constant_velocity"].commands(TURNING | settings)
    changed = config.limits.model_copy()
    for name, value in limits.items():
        kept = getattr(changed, name)
        changed = changed.model_copy(
            update={name: kept.model_copy(update=value) if isinstance(value, dict) else value}
        )
    tight = PlantBench(
        model, device.plant_model(0.0), config.model_copy(update={"limits": changed})
    )
    loose = PlantBench(model, device.plant_model(0.0), config)
    unchanged = free_shaft.families["constant_velocity"].commands(TURNING)
    assert loose.records(unchanged, 1.0 / 800.0, model.nominal[None]) is not None
    assert tight.records(feedback, 1.0 / 800.0, model.nominal[None]) is None


@pytest.mark.soak
def test_a_design_for_a_free_shaft_writes_loops_that_run(tmp_path):
    asked = {
        "rig": "free_shaft.yaml", "model": MODEL, "time": "2.5 s", "run": "2.5 s",
        "protocols": ["constant_velocity", "hysteresis_loop"], "candidates": 8, "generations": 0,
        "draws": 1, "checks": 2, "calibration": 16,
    }  # fmt: skip
    question = write_yaml(tmp_path / "question.yaml", asked)
    done = rig("design", question, "--out", "d", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (designed,) = json.loads(done.stdout)["runs"]
    assert designed["protocol"] in LOOPS and designed["seconds"] <= 2.5
    assert (
        yaml.safe_load((tmp_path / designed["file"]).read_text("utf-8"))["torque_sensor"]
        == "between"
    )
    ran = rig("run", designed["file"], "--json", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    run = json.loads(ran.stdout)["run"]
    assert 5000 <= run["samples"] <= 10_000
    assert "planned" not in record_of(tmp_path / run["folder"])


CONTROLLER = """
from daq.experiment import ClosedLoop, Family, FreeSetting, Plan


class Steam(ClosedLoop):
    pull: float

    @classmethod
    def family(cls, frame):
        return Family({"pull": FreeSetting(0.1, 1.0)}, dict)

    def plan(self):
        return Plan(100, [-1.0, 0.0], [1.0, 0.0])

    def controller(self):
        return self

    def answer(self, sample):
        return "full steam"
"""


def test_mistakes_of_a_protocols_controller_are_told(tmp_path):
    (tmp_path / "steam.py").write_text(CONTROLLER)
    asked = {"rig": "free_shaft.yaml", "model": MODEL, "protocols": ["steam.py:Steam"]}
    question = write_yaml(tmp_path / "question.yaml", asked)
    done = rig("design", question, cwd=tmp_path)
    assert done.returncode == 2
    assert "'steam.py:Steam' failed at simulated sample 0" in done.stderr
    assert MISTAKE in done.stderr and "Traceback" not in done.stderr
