"""A mass on a spring that grows stiffer (Duffing), shaken by a force.

m x'' + d x' + k x + k_3 x^3 = F, as in beams with clamped ends and in MEMS.
"""

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"mass": 0.8, "damping": 9.0, "stiffness": 900.0, "cubic": 2.0e6}
SAMPLE_TIME = 2e-3  # s
LEVELS = (-20.0, 20.0)  # N
HOLD = 30


def derivative(x, u, p):
    position, velocity = x
    mass, damping, stiffness, cubic = p
    spring = (stiffness + cubic * position * position) * position
    return (velocity, (u[0] - damping * velocity - spring) / mass)


model = ProcessModel(
    name="oscillator",
    description="Duffing oscillator under a force",
    states=(State("position", "m"), State("velocity", "m/s")),
    inputs=(Input("force", "N", "zoh"),),
    outputs=(Output("position", "m"),),
    parameters=(
        Parameter("mass", "kg", 1.0, 0.1, 10.0, "log"),
        Parameter("damping", "N*s/m", 5.0, 0.5, 50.0, "log"),
        Parameter("stiffness", "N/m", 500.0, 50.0, 5000.0, "log"),
        Parameter("cubic", "N/m^3", 1e6, 1e4, 1e8, "log"),
    ),
    derivative=derivative,
)
