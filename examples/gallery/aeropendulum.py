"""A pendulum that a propeller at its end pushes.

Thrust goes with the square of the speed that the propeller has come to, which follows the voltage
with a lag; gravity and the bearing work against it. By the pendulum's inertia.
"""

import math

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"thrust": 3.1, "gravity": 24.0, "damping": 0.45, "lag": 0.12}
SAMPLE_TIME = 0.02  # s
LEVELS = (0.0, 1.7)  # V
HOLD = 40


def derivative(x, u, p):
    theta, omega, speed = x
    thrust, gravity, damping, lag = p
    push = thrust * speed * abs(speed)
    return (omega, push - gravity * math.sin(theta) - damping * omega, (u[0] - speed) / lag)


model = ProcessModel(
    name="aeropendulum",
    description="pendulum driven by a propeller",
    states=(State("theta", "rad"), State("omega", "rad/s"), State("speed", "V")),
    inputs=(Input("voltage", "V", "zoh"),),
    outputs=(Output("theta", "rad"),),
    parameters=(
        Parameter("thrust", "rad/(V^2*s^2)", 3.0, 0.3, 30.0, "log"),
        Parameter("gravity", "1/s^2", 20.0, 2.0, 200.0, "log", description="m g l / J"),
        Parameter("damping", "1/s", 1.0, 0.05, 10.0, "log"),
        Parameter("lag", "s", 0.1, 0.02, 1.0, "log", description="of the propeller"),
    ),
    derivative=derivative,
)
