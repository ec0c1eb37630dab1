"""Records of a drive that is what the model says, and of three that are not.

python cases.py         writes sound.csv, friction.csv, late.csv, clipped.csv, and NAME_check.csv
rig identify friction.csv --validate friction_check.csv --config drive.yaml
"""

import numpy as np

TRUTH = {"inertia": 8e-5, "viscous": 4e-4, "dry": 0.02}
SAMPLE_TIME, SAMPLES, HOLD = 2e-3, 3000, 75
FINE = 200  # steps of integration a sample
NOISE = 0.5  # rad/s
CASES = {
    "sound": {},
    "friction": {"dry": TRUTH["dry"]},
    "late": {"late": 3},
    "clipped": {"end": 180.0},
}


def record(seed, dry=0.0, late=0, end=np.inf):
    """Time [s], current [A] and speed [rad/s]; late: samples by which the speed is behind."""
    rng = np.random.default_rng(seed)
    current = np.repeat(rng.uniform(-3.0, 3.0, SAMPLES // HOLD), HOLD)
    omega, speeds, h = 0.0, np.zeros(SAMPLES), SAMPLE_TIME / FINE
    for k in range(SAMPLES):
        speeds[k] = omega
        for _ in range(FINE):
            friction = TRUTH["viscous"] * omega + dry * max(-1.0, min(1.0, omega / 0.05))
            omega += h * (0.05 * current[k] - friction) / TRUTH["inertia"]
    speeds = np.clip(speeds + NOISE * rng.standard_normal(SAMPLES), -end, end)
    logged = np.concatenate([current[late:], np.repeat(current[-1], late)])
    return np.column_stack([np.arange(SAMPLES) * SAMPLE_TIME, logged, speeds])


def save(name, rows):
    """A record as a table."""
    np.savetxt(name, rows, fmt="%.6g", delimiter=",", header="t,current,omega", comments="")


if __name__ == "__main__":
    for case, faults in CASES.items():
        save(f"{case}.csv", record(1, **faults))
        save(f"{case}_check.csv", record(2, **faults))
