"""Two masses on an elastic shaft: a drive whose motor alone is measured.

The load swings against the motor; where their speeds differ the shaft twists and damps a little
(Schröder, "Elektrische Antriebe - Regelung von Antriebssystemen").
"""

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"motor": 0.012, "load": 0.03, "stiffness": 45.0, "shaft": 0.06, "bearing": 0.08}
SAMPLE_TIME = 2e-3  # s
LEVELS = (-4.0, 4.0)  # N*m
HOLD = 15  # samples for which a level is held


def derivative(x, u, p):
    omega, behind, twist = x
    motor, load, stiffness, shaft, bearing = p
    torque = stiffness * twist + shaft * (omega - behind)
    return ((u[0] - torque) / motor, (torque - bearing * behind) / load, omega - behind)


model = ProcessModel(
    name="elastic_shaft",
    description="motor and load on an elastic shaft",
    states=(State("omega", "rad/s"), State("behind", "rad/s"), State("twist", "rad")),
    inputs=(Input("torque", "N*m", "zoh"),),
    outputs=(Output("omega", "rad/s"),),
    parameters=(
        Parameter("motor", "kg*m^2", 0.01, 1e-3, 0.1, "log", description="inertia"),
        Parameter("load", "kg*m^2", 0.02, 2e-3, 0.2, "log", description="inertia"),
        Parameter("stiffness", "N*m/rad", 100.0, 5.0, 500.0, "log"),
        Parameter("shaft", "N*m*s/rad", 0.05, 5e-3, 0.5, "log", description="damping inside"),
        Parameter("bearing", "N*m*s/rad", 0.05, 5e-3, 0.5, "log", description="of the load"),
    ),
    derivative=derivative,
)
