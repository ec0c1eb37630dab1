"""The DC motor of the thesis's section 4.1.4, as a process model of one's own.

States: armature current and speed. Inputs: terminal voltage, held between samples as a
converter holds it, and load torque, interpolated because it changes smoothly.
"""

import numpy as np

from sysid import Guess, Input, Output, Parameter, ProcessModel, State
from sysid.problem.guesses import regression


def derivative(x, u, p):
    current, omega = x
    voltage, load = u
    resistance, inductance, inertia, damping, constant = p
    return (
        (voltage - resistance * current - constant * omega) / inductance,
        (constant * current - damping * omega - load) / inertia,
    )


def guesses(records, known):
    """Resistance and motor constant from voltage = R current + K omega, the inductance settled.

    An output stands before its row's voltage is applied, so it goes with the voltage of the row
    before. Asked for with ``rig identify --guess``.
    """
    voltage, current, omega = (
        np.concatenate([r[name][begin : r.record.n_samples - 1 + begin] for r in records])
        for name, begin in (("voltage", 0), ("current", 1), ("omega", 1))
    )
    fitted = regression(voltage, [current, omega])
    if fitted is None:
        return {}
    values, covariance = fitted
    # The winding has not quite settled where the voltage has just changed: a tenth either way.
    spread = 3.0 * np.sqrt(np.diag(covariance)) + 0.1 * np.abs(values)
    names = ", ".join(r.name for r in records)
    return {
        name: Guess(
            max(value - off, 0.0), value + off, f"voltage over current and speed in {names}"
        )
        for name, value, off in zip(("resistance", "constant"), values, spread, strict=True)
        if value > 0.0
    }


def around(value, factor):
    return {"nominal": value, "lower": value / factor, "upper": value * factor, "scale": "log"}


model = ProcessModel(
    name="dc_motor",
    description="brushed DC motor with viscous damping",
    states=(State("current", "A"), State("omega", "rad/s")),
    inputs=(Input("voltage", "V", "zoh"), Input("load", "N*m", "foh")),
    outputs=(Output("current", "A"), Output("omega", "rad/s")),
    parameters=(
        Parameter("resistance", "ohm", **around(1.0, 10.0)),
        Parameter("inductance", "H", **around(6e-4, 10.0)),
        Parameter("inertia", "kg*m^2", **around(8e-7, 10.0)),
        Parameter("damping", "N*m*s/rad", **around(1.33e-5, 10.0)),
        Parameter("constant", "N*m/A", **around(2.38e-2, 10.0)),
    ),
    derivative=derivative,
    guesses=guesses,
)
