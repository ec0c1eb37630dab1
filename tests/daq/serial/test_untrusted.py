"""What a device says is compared with what it does: its clock, its samples, its outputs."""

import numpy as np
import pytest

from tests.daq.serial.paper import paper_device
from tests.daq.serial.support import write_serial_rig
from tests.daq.support import forked_rig, only_capture, record_of, rows_in, write_experiment


@pytest.fixture(scope="module")
def rig():
    with forked_rig() as run:
        yield run


def run_on(rig, folder, seconds=0.4, limits=None, **lies):
    """``rig run`` on a device with these lies: the process, and its run.json."""
    with paper_device(**lies) as port:
        write_serial_rig(folder / "rig.yaml", port, watchdog=0.5)
        if limits:
            with (folder / "rig.yaml").open("a") as text:
                text.write(f"limits: {limits}\n")
        write_experiment(folder / "e.yaml", duration=seconds, calibration={"samples": 100})
        result = rig(["run", "e.yaml", "--rig", "rig.yaml"], folder)
    assert "Traceback" not in result.stderr
    return result, record_of(only_capture(folder))


def test_a_device_that_keeps_the_rules_completes(rig, tmp_path):
    result, record = run_on(rig, tmp_path)
    assert result.returncode == 0, result.stderr
    assert record["status"] == "completed"
    assert record["connection"]["warnings"] == []


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_clock_of_another_frequency_is_refused_before_the_rig_moves(rig, tmp_path, share):
    result, record = run_on(rig, tmp_path, clock=share)
    assert result.returncode == 1 and record["status"] == "failed"
    assert rows_in(only_capture(tmp_path)) == 0
    assert ("too fast" if share > 1.0 else "too slow") in record["reason"]
    assert "WELCOME" in record["reason"] and record["reason"] in result.stderr


def test_a_timer_that_divides_wrongly_is_refused_before_the_rig_moves(rig, tmp_path):
    result, record = run_on(rig, tmp_path, timer=1.1)
    assert result.returncode == 1 and record["status"] == "failed"
    assert "by its own clock the device took" in record["reason"]
    assert rows_in(only_capture(tmp_path)) == 0


@pytest.mark.parametrize(
    ("timer", "seconds"), [(1.1, 2), pytest.param(0.9, 8, marks=pytest.mark.soak)]
)
def test_samples_that_come_at_another_rate_are_refused_whatever_the_device_says(
    rig, tmp_path, timer, seconds
):
    result, record = run_on(rig, tmp_path, seconds=seconds, timer=timer, times=False)
    assert result.returncode == 1 and record["status"] == "failed"
    assert "800 Hz" in record["reason"] and rows_in(only_capture(tmp_path)) < 800 * seconds
