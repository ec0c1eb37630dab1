"""What a device says is compared with what it does: its clock, its samples, its outputs."""

import numpy as np
import pytest

from daq.logs.recording import load
from tests.daq.serial.paper import I32, SAFE, paper_device
from tests.daq.serial.support import write_serial_rig
from tests.daq.support import forked_rig, only_capture, record_of, rows_in, write_experiment
from tests.soak import mostly_soak


@pytest.fixture(scope="module")
def rig():
    with forked_rig() as run:
        yield run


def run_on(rig, folder, seconds=0.4, limits=None, calibration=100, **lies):
    """``rig run`` on a device with these lies: the process, and its run.json."""
    with paper_device(**lies) as port:
        write_serial_rig(folder / "rig.yaml", port, watchdog=0.5)
        if limits:
            with (folder / "rig.yaml").open("a") as text:
                text.write(f"limits: {limits}\n")
        write_experiment(folder / "e.yaml", duration=seconds, calibration={"samples": calibration})
        result = rig(["run", "e.yaml", "--rig", "rig.yaml"], folder)
    assert "Traceback" not in result.stderr
    return result, record_of(only_capture(folder))


def test_a_device_that_keeps_the_rules_completes(rig, tmp_path):
    result, record = run_on(rig, tmp_path)
    assert result.returncode == 0, result.stderr
    assert record["status"] == "completed"
    assert record["connection"]["warnings"] == []
    assert record["outputs"]["confirmed"] and record["outputs"]["applied_voltage_motor"] == 0.0


@pytest.mark.parametrize("share", mostly_soak([0.9, 1.1]))
def test_a_clock_of_another_frequency_is_refused_before_the_rig_moves(rig, tmp_path, share):
    result, record = run_on(rig, tmp_path, calibration=400, clock=share)
    assert result.returncode == 1 and record["status"] == "failed"
    assert rows_in(only_capture(tmp_path)) == 0
    assert ("too fast" if share > 1.0 else "too slow") in record["reason"]
    assert "clock" in record["reason"] and record["reason"] in result.stderr


def test_a_timer_that_divides_wrongly_is_refused_before_the_rig_moves(rig, tmp_path):
    result, record = run_on(rig, tmp_path, timer=0.9)
    assert result.returncode == 1 and record["status"] == "failed"
    assert "by its own clock the device took" in record["reason"]
    assert rows_in(only_capture(tmp_path)) == 0


@pytest.mark.parametrize(
    ("timer", "seconds"),
    mostly_soak([(1.1, 2), (0.95, 3), (0.9, 4), (0.97, 4)]),
)
def test_samples_that_come_at_another_rate_are_refused_whatever_the_device_says(
    rig, tmp_path, timer, seconds
):
    result, record = run_on(rig, tmp_path, seconds=seconds, timer=timer, times=False)
    assert result.returncode == 1 and record["status"] == "failed"
    assert "800 Hz" in record["reason"] and rows_in(only_capture(tmp_path)) < 800 * seconds


@pytest.mark.parametrize(
    ("lies", "problem"),
    mostly_soak(
        [
            ({"sticks": "output"}, "V are applied to the motor"),
            ({"sticks": "amplifier"}, "A at zero command, where calibration.current_"),
            ({"deaf": (SAFE,)}, "does not answer SAFE"),
        ],
        always=2,
    ),
    ids=["converter", "amplifier", "no SAFE"],
)
def test_outputs_are_called_zero_only_when_they_were_read_as_zero(rig, tmp_path, lies, problem):
    result, record = run_on(rig, tmp_path, **lies)
    assert result.returncode == 1 and record["status"] == "failed"
    assert problem in record["reason"]
    assert rows_in(only_capture(tmp_path)) == 320
    assert not record["outputs"]["confirmed"] and problem in record["outputs"]["problem"]
    assert "switch off the amplifier: zero outputs are not confirmed" in result.stderr


def test_a_log_without_most_of_its_samples_is_not_complete(rig, tmp_path):
    result, record = run_on(rig, tmp_path, loses=lambda tick: tick % 10 != 0)
    assert result.returncode == 1 and record["status"] == "incomplete"
    assert "of the run's 320 samples are missing" in record["reason"]
    assert "limits.lost" in result.stderr and record["outputs"]["confirmed"]


@pytest.mark.parametrize(
    ("allowed", "status"), mostly_soak([(0.01, "incomplete"), (0.05, "completed")])
)
def test_the_last_samples_count_too_and_a_user_says_how_many(rig, tmp_path, allowed, status):
    # Of 320: what the device takes after them ends the run.
    limits = f"{{lost: {allowed}}}"
    result, record = run_on(rig, tmp_path, limits=limits, loses=lambda tick: 312 <= tick < 325)
    assert record["status"] == status and result.returncode == (status != "completed")
    assert rows_in(only_capture(tmp_path)) == 312


def turning(bits, way=1):
    """Counts that stand still for 150 samples, then go over the end of a counter, 3 a sample."""
    return lambda tick: way * (2 ** (bits - 1) - 50 + 3 * max(0, tick - 150))


I16 = (-(2**15), 2**15 - 1)


@pytest.mark.parametrize(
    ("bits", "counter", "way"),
    mostly_soak([(16, I16, -1), (32, I32, 1), (32, I32, -1), (16, I16, 1)]),
)
def test_a_counter_that_runs_over_is_followed(rig, tmp_path, bits, counter, way):
    result, _ = run_on(rig, tmp_path, counts=turning(bits, way), bits=bits, counter=counter)
    assert result.returncode == 0, result.stderr
    theta = load(only_capture(tmp_path)).frame["theta"].to_numpy()
    counts = np.rint((theta - theta[0]) * 8192 / (2.0 * np.pi))
    assert np.array_equal(counts, way * 3 * np.maximum(0, np.arange(320) - 150))


def test_a_counter_of_16_bits_that_says_32_is_named(rig, tmp_path):
    result, record = run_on(rig, tmp_path, counts=turning(16), bits=16)
    assert result.returncode == 1 and record["status"] == "failed"
    assert "as a counter of 16 bits does that runs over" in record["reason"]


@pytest.mark.parametrize(
    ("output", "said"),
    mostly_soak(
        [
            (lambda tick, codes: (codes[0] + 400 * (tick == 200), codes[1]), "to the motor"),
            (lambda tick, codes: (codes[0], 9000 if tick == 200 else codes[1]), "9 V to the brake"),
        ]
    ),
)
def test_a_device_that_applies_another_voltage_is_stopped(rig, tmp_path, output, said):
    result, record = run_on(rig, tmp_path, output=output)
    assert result.returncode == 1 and record["status"] == "interlock"
    assert "interlock in sample 200: the device applies another voltage" in record["reason"]
    assert said in record["reason"] and rows_in(only_capture(tmp_path)) == 201


def test_what_a_flag_does_not_mean_is_disobedience_all_the_same(rig, tmp_path):
    _, record = run_on(
        rig, tmp_path, flags=lambda tick: 1, output=lambda tick, codes: (0, 1000 * (tick == 300))
    )
    assert "interlock in sample 300" in record["reason"] and "1 V to the brake" in record["reason"]
    assert "CLAMPED does not say why" in record["reason"]


def test_an_input_at_its_converters_end_is_named_with_the_cure(rig, tmp_path):
    result, record = run_on(
        rig, tmp_path, flags=lambda tick: 32 * (tick == 200), saturates=lambda tick: tick == 200
    )
    assert result.returncode == 0, result.stderr
    assert "torque stood at the end of its converter's range in 1 sample:" in result.stderr
    assert record["saturated_samples"] == {"current_motor": 0, "current_brake": 0, "torque": 1}
