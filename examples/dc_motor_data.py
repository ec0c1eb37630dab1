"""Noise-free records of the DC motor of the thesis's section 4.1.4, to try the identification on.

python dc_motor_data.py            writes training.csv and validation.csv here
rig identify training.csv --validate validation.csv --config dc_motor.yaml
"""

from pathlib import Path

import numpy as np
from dc_motor import model

from sysid import BatchSimulator, Dataset

SAMPLE_TIME = 0.01  # s
SAMPLES = 200


def record(period, duty, load_frequency, load_amplitude):
    """A square voltage of 1 V and a sinusoidal load torque, with the motor's response."""
    t = np.arange(SAMPLES) * SAMPLE_TIME
    voltage = np.where(np.mod(t, period) < duty * period - 1e-9, 1.0, -1.0)
    load = load_amplitude * np.sin(2.0 * np.pi * load_frequency * t)
    inputs = np.stack([voltage, load], axis=1)
    blank = Dataset(inputs, np.zeros((SAMPLES, 2)), SAMPLE_TIME)
    outputs = BatchSimulator(model, accuracy=1e-9).trajectories(model.nominal, blank)[0]
    return Dataset(inputs, outputs, SAMPLE_TIME)


def training():
    """Square voltage with a period of 1 s, load of 0.01 N*m at 0.3 Hz."""
    return record(1.0, 0.5, 0.3, 0.01)


def validation():
    """Period 0.5 s at 40 % duty, load of 0.02 N*m at 0.4 Hz."""
    return record(0.5, 0.4, 0.4, 0.02)


if __name__ == "__main__":
    for name, data in (("training.csv", training()), ("validation.csv", validation())):
        table = np.column_stack([data.time, data.inputs, data.outputs])
        head = "t,voltage,load,current,omega"
        np.savetxt(Path(name), table, delimiter=",", header=head, comments="")
        print(name)
