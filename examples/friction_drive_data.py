"""Records of a linear drive that sticks and slides, to try the identification on.

python friction_drive_data.py      writes drive_training.csv and drive_validation.csv here
rig identify drive_training.csv --validate drive_validation.csv --config friction_drive.yaml

The motion is worked out in closed form from one stop to the next, not by integrating the model
that is to be found: where the force does not overcome dry friction, the carriage stands. A
controller makes it follow smooth strokes; a noisy sensor beside it measures the position.
"""

import math
from pathlib import Path

import numpy as np

TRUTH = {"mass": 95.0, "viscous": 200.0, "dry": 20.0, "offset": -3.0}
FORCE_PER_VOLT = 35.0  # N/V
SAMPLE_TIME = 1e-3  # s
NOISE = 1e-4  # m
STIFFNESS, DAMPING = 600.0, 45.0  # of the controller, V/m and V*s/m


def advance(position, velocity, force, left):
    """Position and velocity after a time ``left`` under a held force."""
    mass, viscous, dry, offset = TRUTH.values()
    net, tau = force - offset, mass / viscous
    while left > 0.0:
        if velocity == 0.0 and abs(net) <= dry:
            break
        direction = math.copysign(1.0, velocity if velocity != 0.0 else net)
        final = (net - direction * dry) / viscous
        stops = velocity * final < 0.0
        time = min(left, tau * math.log(1.0 - velocity / final)) if stops else left
        fading = math.exp(-time / tau)
        position += final * time + (velocity - final) * tau * (1.0 - fading)
        velocity = 0.0 if stops and time < left else final + (velocity - final) * fading
        left -= time
    return position, velocity


def record(stroke, duration, samples, seed):
    """Time [s], voltage [V] and measured position [m] of strokes forth and back."""
    noise = np.random.default_rng(seed).normal(0.0, NOISE, samples)
    time = np.arange(samples) * SAMPLE_TIME
    phase = np.mod(time / duration, 2.0)
    share = np.where(phase < 1.0, phase, 2.0 - phase)
    wanted = stroke * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    position = velocity = 0.0
    rows = []
    for t, target, error in zip(time, wanted, noise, strict=True):
        voltage = STIFFNESS * (target - position) - DAMPING * velocity
        voltage = round(min(max(voltage, -10.0), 10.0), 4)
        rows.append((t, voltage, position + error))
        position, velocity = advance(position, velocity, FORCE_PER_VOLT * voltage, SAMPLE_TIME)
    return np.array(rows)


def training():
    """Ten seconds of strokes of 120 mm."""
    return record(0.12, 1.0, 10_000, seed=1)


def validation():
    """Five seconds of shorter and slower strokes."""
    return record(0.09, 1.3, 5_000, seed=2)


def save(path, rows):
    """A table in the units of the test bench."""
    head = "Time [ms],Voltage [V],Position [mm]"
    np.savetxt(path, rows * [1e3, 1.0, 1e3], fmt="%.4f", delimiter=",", header=head, comments="")


if __name__ == "__main__":
    for name, rows in (("drive_training", training()), ("drive_validation", validation())):
        save(Path(f"{name}.csv"), rows)
        print(f"{name}.csv")
