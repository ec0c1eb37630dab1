"""The DC motor of the thesis's section 4.1.4, as a process model of one's own.

States: armature current and speed. Inputs: terminal voltage, held between samples as a
converter holds it, and load torque, interpolated because it changes smoothly.
"""

from sysid import Input, Output, Parameter, ProcessModel, State


def derivative(x, u, p):
    current, omega = x
    voltage, load = u
    resistance, inductance, inertia, damping, constant = p
    return (
        (voltage - resistance * current - constant * omega) / inductance,
        (constant * current - damping * omega - load) / inertia,
    )


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
)
