"""Safety as a user meets it: plans refused, limits of one's own, calibration, timing."""

import ctypes
import gc
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from daq.config.rig import RigConfig
from daq.errors import RunError
from daq.hal import Flag, Phase
from daq.run.realtime import RealTime
from daq.run.runner import run_experiment
from daq.run.timing import Histogram
from protocols.prbs import Prbs
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.support import (
    EXPERIMENT,
    RIG,
    environment,
    forked_rig,
    install,
    merged,
    only_capture,
    record_of,
    write_experiment,
    write_rig,
)
from tests.soak import mostly_soak

EXAMPLES = Path(__file__).parents[2] / "examples"
DOCS = EXAMPLES.parent / "docs"
STEADY = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan


class Steady(ClosedLoop):
    """A constant pull; what it says of its plan is a setting."""

    columns = {"omega_ref": "rad/s"}
    speed: float = 10.0
    volts: float = 0.5

    def plan(self):
        speeds = np.linspace(0.0, self.speed, 400)
        return Plan(400, np.zeros(2), np.array([1.0, 0.2]), references={"omega_ref": speeds})

    def controller(self):
        return self

    def answer(self, sample):
        return Answer(self.volts, 0.0, (self.speed,))
'''


@pytest.fixture(scope="module")
def run():
    with forked_rig() as run:
        yield run


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "steady.py").write_text(STEADY)
    (tmp_path / "steady.yaml").write_text(
        "protocol: steady.py:Steady\nsample_rate: 800\ncalibration: {samples: 100}\n"
    )
    (tmp_path / "brake_power.py").write_text((EXAMPLES / "brake_power.py").read_text("utf-8"))
    return tmp_path


# --- plans ----------------------------------------------------------------------------------

REFUSED = {
    "slew": ({}, {"limits": {"slew": {"motor": 1000}}}, "e.yaml:6:1: motor: the plan changes the "
             "command at 1200 V/s in sample"),
    "current": ({"motor": {"amplitude": 2.0}},
                {"amplifiers": {"motor": 0.5}, "limits": {"current": {"motor": 1.0}}},
                "1.05 A by amplifiers.motor, beyond limits.current.motor of 1 A"),
    # Levels of 0.85 V and -0.65 V: 0.425 A and 0.325 A.
    "i2t": ({}, {"amplifiers": {"motor": 0.5},
                 "limits": {"i2t": {"motor": {"continuous": 0.2, "budget": 0.01}}}},
            "A^2*s above 0.2 A, beyond the budget of limits.i2t.motor, 0.01 A^2*s"),
    "homing": ({"homing": {"turns": 1}}, {"limits": {"winding": 2}},
               "homing.turns: 1 turns are wound, and limits.winding"),
    "travel": ({"homing": {"turns": 9}}, {"limits": {"travel": [-2, 4]}},
               "homing.turns: 9 turns are outside limits.travel"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("command", ["run", "check"])
def test_a_plan_beyond_a_limit_is_refused_with_sample_and_value(run, tmp_path, name, command):
    changes, rig_changes, said = REFUSED[name]
    write_experiment(tmp_path / "e.yaml", **changes)
    write_rig(tmp_path / "rig.yaml", **rig_changes)
    result = run([command, "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 2, result.stderr
    assert said in " ".join(result.stderr.split())
    assert not (tmp_path / "runs").exists()


def test_where_a_plan_passes_the_budget_of_its_winding_is_where_it_says(run, tmp_path):
    constant = {"amplitude": 0.0, "offset": 2.0}
    write_experiment(tmp_path / "e.yaml", duration=4, motor=constant)
    load = {"motor": {"continuous": 0.5, "budget": 1.4995}}
    write_rig(tmp_path / "rig.yaml", amplifiers={"motor": 0.5}, limits={"i2t": load})
    result = run(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    # 1.5 A^2 s at 1 A over 0.5 A last 2 s.
    assert result.returncode == 2 and "by sample 1599 (1.999 s)" in result.stderr, result.stderr


def test_planned_speeds_beyond_the_limit_are_refused(run, folder):
    write_rig(folder / "rig.yaml", limits={"speed": 8.0})
    result = run(["run", "steady.yaml", "--rig", "rig.yaml"], folder)
    assert result.returncode == 2
    assert "omega_ref: the plan asks for 10 rad/s in sample 399, beyond" in result.stderr


# --- runs -----------------------------------------------------------------------------------


def test_a_cable_that_unwinds_ends_the_run_with_its_sample_in_the_log(run, tmp_path):
    write_experiment(
        tmp_path / "e.yaml", duration=20, homing={"turns": 1, "timeout": 30},
        motor={"amplitude": 0.1, "offset": -0.5}, brake={"amplitude": 0.0, "offset": 0.0},
    )  # fmt: skip
    write_rig(tmp_path / "rig.yaml", limits={"winding": 0.5})
    result = run(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 1, result.stdout
    record = record_of(only_capture(tmp_path))
    assert record["status"] == "interlock" and "nearly unwound" in record["reason"]
    log = pd.read_csv(only_capture(tmp_path) / "log.csv")
    assert log["flags"].iloc[-1] == int(Flag.INTERLOCK) and not log["flags"].iloc[:-1].any()
    assert f"interlock in sample {log['tick'].iloc[-1]}:" in record["reason"]


def test_a_limit_of_ones_own_stops_a_run_as_the_docs_say(run, folder):
    text = (DOCS / "safety.md").read_text(encoding="utf-8")
    shown = [part.split("```")[0] for part in text.split("```python\n")[1:]]
    assert (EXAMPLES / "brake_power.py").read_text(encoding="utf-8") in shown
    write_rig(
        folder / "rig.yaml", limits={"own": [{"use": "brake_power.py:BrakePower",
                                              "options": {"most": "500 mW", "over": "0.1 s"}}]}
    )  # fmt: skip
    (folder / "pull.yaml").write_text((folder / "steady.yaml").read_text("utf-8") + "volts: 1.0\n")
    result = run(["run", "pull.yaml", "--rig", "rig.yaml"], folder)
    assert result.returncode == 1, result.stdout
    assert "the brake takes 0.5" in result.stderr and "its limit of 0.5 W" in result.stderr
    log = pd.read_csv(only_capture(folder) / "log.csv")
    # As soon as the very sample is seen: it is answered by no command any more.
    average, forget = 0.0, np.exp(-1.0 / 80.0)
    for row, power in enumerate(np.abs(log["torque"] * log["omega"])):
        average = forget * average + (1.0 - forget) * power
        assert (average > 0.5) == (row == len(log) - 1)
    assert log["flags"].iloc[-1] & int(Flag.INTERLOCK)


@pytest.mark.soak
def test_a_limit_of_an_installed_package_is_found_by_its_name(tmp_path):
    text = (
        "from daq.limits import Limit\n\n\n"
        "class Never(Limit):\n    def check(self, samples):\n        return 0, 'never'\n"
    )
    found = install(tmp_path / "lib", "never_limit", text, "rig.limits", "never", "Never")
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", limits={"own": [{"use": "never"}]})
    with forked_rig(**found) as run:
        result = run(["run", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 1 and "interlock during calibration: never" in result.stderr


OWN = {
    "no such file": ("absent.py:Power", {}, 2, "own.0.use: absent.py: there is no such limit file"),
    "no such class": ("brake_power.py:Power", {}, 2, "did you mean 'BrakePower'"),
    "no limit": ("brake_power.py:Options", {}, 2, "is no limit; make it a class derived from"),
    "not installed": ("nothing", {}, 2, "limits.own.0.use: unknown limit 'nothing'"),
    "a setting missing": ("brake_power.py:BrakePower", {}, 2, "own.0.options.most: this key is"),
    "a wrong setting": ("brake_power.py:BrakePower", {"most": -1}, 2, "options.most: it must"),
    "settings of one without": ("own.py:Bad", {"most": 1}, 2, "options: the limit own.py:Bad has"),
    "one that fails": ("own.py:Bad", {}, 1, "the limit Bad failed: ZeroDivisionError"),
    "one that answers nonsense": ("own.py:Odd", {}, 1, "the limit Odd answered (-1, 'x') to"),
}  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_a_mistake_in_a_limit_of_ones_own_is_named(run, folder, name):
    use, options, status, said = OWN[name]
    (folder / "own.py").write_text(
        "from daq.limits import Limit\n\n\n"
        "class Bad(Limit):\n    def check(self, samples):\n        return 1 // 0\n\n\n"
        "class Odd(Limit):\n    def check(self, samples):\n        return -1, 'x'\n"
    )
    write_rig(folder / "rig.yaml", limits={"own": [{"use": use, "options": options}]})
    result = run(["run", "steady.yaml", "--rig", "rig.yaml"], folder)
    assert result.returncode == status, result.stderr
    assert said in result.stderr and "Traceback" not in result.stderr
    assert (status == 1) == (folder / "runs").exists()


# --- calibration ----------------------------------------------------------------------------


class Restless(SimulatedDevice):
    """The simulated rig whose shaft turns, or whose motor draws a current, at zero command."""

    def __init__(self, turns_per_second, volts):
        super().__init__(Simulation())
        self.turns, self.volts = turns_per_second, volts

    def receive(self):
        raw = super().receive()
        raw.counts[:] += np.floor(8192 * self.turns * raw.tick / 800)
        raw.analog[:, 0] += self.volts
        return raw


@pytest.mark.parametrize(
    ("turns", "volts", "said"),
    [
        (
            0.05,
            0.0,
            "the shaft moved by 0.0499 turns at zero command, more than",
        ),
        (0.0, 0.3, "current_motor reads 0.15"),
    ],
)
def test_a_rig_that_is_not_at_rest_is_not_calibrated(tmp_path, turns, volts, said):
    experiment = Prbs(**merged(EXPERIMENT, {"calibration": {"samples": 800}}))
    with pytest.raises(RunError, match=said):
        run_experiment(experiment, "e", RigConfig(), Restless(turns, volts), tmp_path)
    (folder,) = tmp_path.iterdir()
    record = record_of(folder)
    assert (record["status"], record["phase"]) == ("failed", "calibration")
    assert "raise calibration" in record["reason"] or "hands off" in record["reason"]
    wider = {"samples": 800, "motion": 0.1, "current_motor": 0.2}
    experiment = Prbs(**merged(EXPERIMENT, {"calibration": wider}))
    result = run_experiment(experiment, "e", RigConfig(), Restless(turns, volts), tmp_path)
    assert result.n_samples == 400


# --- time -----------------------------------------------------------------------------------


def test_late_commands_and_lost_samples_are_counted_where_the_log_has_them(run, folder):
    faults = {"faults": {"late": 0.05, "lost": 0.03}}
    write_rig(folder / "rig.yaml", options=faults, limits={"lost": 0.1})
    result = run(["run", "steady.yaml", "--rig", "rig.yaml"], folder)
    assert result.returncode == 0, result.stderr
    log = pd.read_csv(only_capture(folder) / "log.csv")
    timing = record_of(only_capture(folder))["timing"]
    held = log["tick"][(log["flags"] & int(Flag.HELD)) != 0].tolist()
    gaps = np.diff(log["tick"], prepend=-1)
    before = (log["tick"] - gaps)[gaps > 1].tolist()
    assert len(held) > 5 and len(before) > 3, "the case has some of both"
    assert timing["late"] == {"commands": len(held), "first_ticks": held[:20]}
    assert timing["lost"]["samples"] == int((gaps - 1).sum())
    assert timing["lost"]["after_ticks"] == before[:20]
    assert timing["answer"]["count"] == timing["arrival"]["count"] == len(log)
    assert sum(timing["answer"]["histogram"]["counts"]) == len(log)
    assert f"{len(held)} commands of {len(log)} came too late" in result.stderr
    assert "samples did not arrive (after samples" in result.stderr


def test_quantiles_of_the_histogram_are_those_of_the_durations():
    durations = np.random.default_rng(3).lognormal(11.0, 2.0, 5000).astype(int)
    histogram = Histogram()
    for tick, duration in enumerate(durations.tolist()):
        histogram.add(duration, tick)
    for share in (0.1, 0.5, 0.99):
        true = np.quantile(durations, share) * 1e-9
        assert true <= histogram.quantile(share) * 1.001 and histogram.quantile(share) < 1.3 * true
    summary = histogram.summary()
    assert summary["worst_tick"] == int(np.argmax(durations))
    assert summary["worst_seconds"] == pytest.approx(durations.max() * 1e-9)
    assert summary["mean_seconds"] == pytest.approx(durations.mean() * 1e-9)
    ends, counts = summary["histogram"]["up_to_seconds"], summary["histogram"]["counts"]
    for end, count in zip(np.multiply(ends, 1e9), np.cumsum(counts), strict=True):
        assert np.count_nonzero(durations < round(end)) == count


@pytest.fixture
def collector():
    """The garbage collector, which leaves aside afterwards what it did before."""
    yield gc
    gc.freeze()


@pytest.mark.parametrize("left_aside", mostly_soak([True, False]))
def test_everything_of_real_time_is_given_back(left_aside, collector):
    collector.unfreeze()
    if left_aside:
        collector.freeze()
    enabled, frozen = gc.isenabled(), gc.get_freeze_count()
    kind = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
    realtime = RealTime()
    realtime.begin("prefer")
    assert not gc.isenabled()
    assert {"garbage_collector", "scheduler", "memory"} >= {*realtime.granted} - {"priority"}
    realtime.undo()
    assert (gc.isenabled(), gc.get_freeze_count()) == (enabled, frozen)
    if kind is not None:  # the mark stays from an earlier run in this process, too
        mark = os.SCHED_RESET_ON_FORK
        assert os.sched_getscheduler(0) & ~mark == kind & ~mark


# Becomes a program that may neither schedule in real time nor lock memory, root or not.
_UNPRIVILEGED = """
import ctypes, os, resource, sys
for capability in (14, 23):  # CAP_IPC_LOCK, CAP_SYS_NICE
    ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None) if os.name == "posix" else None, "prctl"),
                    reason="capabilities of Linux")  # fmt: skip
@pytest.mark.parametrize("asked", mostly_soak(["require", "prefer"]))
def test_without_the_right_to_it_real_time_is_refused_or_done_without(tmp_path, asked):
    write_experiment(tmp_path / "e.yaml", duration=0.1)
    write_rig(tmp_path / "rig.yaml", realtime=asked, options={"time": "real"})
    result = subprocess.run(
        [sys.executable, "-c", _UNPRIVILEGED, *RIG, "run", "e.yaml", "--rig", "rig.yaml"],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    record = record_of(only_capture(tmp_path))
    if asked == "require":
        assert result.returncode == 2
        assert "realtime: required, but not granted: scheduler: SCHED_FIFO: " in result.stderr
        assert "rtprio" in result.stderr and "memlock" in result.stderr
        assert record["phase"] == "open", "before anything is energised"
        return
    assert result.returncode == 0, result.stderr
    assert record["realtime"]["granted"] == {"garbage_collector": "off"}
    assert set(record["realtime"]["refused"]) == {"scheduler", "memory"}
    assert re.search(r"Timing: samples came (in blocks of \d+, )?every ", result.stdout)
    assert "scheduling: ordinary" in result.stdout


def test_a_clock_that_waits_needs_no_real_time(run, tmp_path):
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", realtime="require")
    result = run(["run", "e.yaml", "--rig", "rig.yaml", "--json"], tmp_path)
    assert result.returncode == 0, result.stderr
    realtime = json.loads(result.stdout)["run"]["realtime"]
    assert realtime == {"asked": "require", "needed": False, "granted": {}, "refused": {}}
    (tmp_path / "rig.yaml").write_text("backend: simulated\nrealtime: off\n")
    result = run(["check", "e.yaml", "--rig", "rig.yaml"], tmp_path)
    assert result.returncode == 0, result.stderr


def test_homing_is_announced_with_the_turns_it_waits_for(tmp_path):
    seen = []
    experiment = Prbs(**merged(EXPERIMENT, {"homing": {"turns": 1.0, "timeout": 30.0}}))
    device = SimulatedDevice(Simulation())
    run_experiment(experiment, "e", RigConfig(), device, tmp_path, seen.append)
    counts = [step.done for step in seen if step.phase is Phase.HOMING]
    assert len(counts) > 20 and counts == sorted(counts) and counts[-1] == 1.0
