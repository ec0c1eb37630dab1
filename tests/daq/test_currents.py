"""What is said of currents after a run, by logs of which the gains are known."""

import re

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.diagnose.currents import notes

RATE, N = 800.0, 3200
NOISE = 0.005  # A
CONFIG = RigConfig.model_validate(
    {"amplifiers": {"motor": 0.5, "brake": 0.5}, "limits": {"speed": 150.0}}
)
STEPS = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, N // 80), 80)
BRAKE = np.repeat(np.random.default_rng(2).choice([0.0, 0.1], N // 160), 160)
SWAPPED = ((0.0, 0.5), (0.5, 0.0))


def notes_on(folder, gains=((0.5, 0.0), (0.0, 0.5)), motor=STEPS, brake=BRAKE, omega=0.0, **noise):
    """Of a log of currents with gains (2, 2) [A/V] by both commands (n,) [V]; omega in rad/s."""
    volts = np.array([motor, brake])
    spread = noise.get("noise", NOISE)
    currents = gains @ volts + np.random.default_rng(3).normal(0.0, spread, volts.shape)
    # A supply of 24 V, of which the back EMF takes at speed.
    currents[0] = np.clip(currents[0], -2.0 + 0.016 * omega, 2.0 - 0.016 * omega)
    speed = np.broadcast_to(omega, N)
    log = np.column_stack([np.arange(N) / RATE, *currents, *volts, speed])
    names = "t,current_motor,current_brake,applied_voltage_motor,applied_voltage_brake,omega"
    np.savetxt(folder / "log.csv", log, delimiter=",", header=names, comments="")
    return notes(folder / "log.csv", CONFIG)


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        (((-0.5, 0.0), (0.0, 0.5)), ["'sign: -1' of sensors.current_motor"]),
        (((0.5, 0.0), (0.0, -0.5)), ["'sign: -1' of sensors.current_brake"]),
        (((0.25, 0.0), (0.0, 0.5)), ["sensors.current_motor.scale"]),
        (((0.5, 0.0), (0.0, 1.0)), ["sensors.current_brake.scale"]),
        (((0.0, 0.0), (0.0, 0.5)), ["current_motor follows .* whether the amplifier is on"]),
        (SWAPPED, ["current_motor .* the two channels are swapped"]),
        (((0.5, 0.0), (0.0, 0.5)), []),
    ],
)
def test_each_mistake_is_said_of_its_channel_alone(tmp_path, gains, said):
    texts = notes_on(tmp_path, np.array(gains))
    assert len(texts) == len(said)
    for text, part in zip(texts, said, strict=True):
        assert re.search(part, text), text


def test_a_swap_is_said_of_commands_that_resemble_each_other(tmp_path):
    brake = 0.1 * np.abs(STEPS) + 0.05 * (STEPS > 0.0)
    motor = np.abs(STEPS)
    texts = notes_on(tmp_path, np.array(SWAPPED), motor, brake)
    assert texts and all("swapped" in text for text in texts)
    assert notes_on(tmp_path, motor=motor, brake=brake) == []


def test_no_swap_is_said_of_commands_that_nobody_can_tell_apart(tmp_path):
    alike = {"motor": np.abs(STEPS), "brake": 0.1 * np.abs(STEPS)}
    assert notes_on(tmp_path, **alike) == []
    assert "swapped" not in " ".join(notes_on(tmp_path, np.array(SWAPPED), **alike))


def test_what_a_motor_lacks_at_speed_is_not_held_against_it(tmp_path):
    fast = np.where(np.arange(N) < N // 4, 5.0, 110.0)
    assert notes_on(tmp_path, motor=2.0 + STEPS, omega=fast) == []
    assert notes_on(tmp_path, motor=2.0 + STEPS, omega=110.0) == []


def test_a_current_of_exactly_nothing_is_said_without_a_warning(tmp_path):
    texts = notes_on(tmp_path, np.zeros((2, 2)), noise=0.0)
    assert len(texts) == 2 and all("whether the amplifier is on" in text for text in texts)
