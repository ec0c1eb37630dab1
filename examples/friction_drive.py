"""A linear drive with dry friction, as a process model of one's own.

A voltage makes a force (the gain of amplifier, motor and spindle is known from their data
sheets), a carriage moves against viscous and dry friction and a constant force (a cable, a slope),
and a sensor sees its position.
"""

from sysid import Input, Output, Parameter, ProcessModel, State

FORCE_PER_VOLT = 35.0  # N/V
STANDING = 1e-5  # m/s, below which dry friction holds the carriage


def derivative(x, u, p):
    _position, velocity = x
    (voltage,) = u
    mass, viscous, dry, offset = p
    direction = max(-1.0, min(1.0, velocity / STANDING))
    friction = viscous * velocity + dry * direction
    return (
        velocity,
        (FORCE_PER_VOLT * voltage - friction - offset) / mass,
    )


model = ProcessModel(
    name="friction_drive",
    description="linear drive with viscous and dry friction",
    states=(
        # Where it starts is estimated: the first sample's noise would stay in every later one.
        State("position", "m", initial_range=(-0.01, 0.01)),
        State("velocity", "m/s"),
    ),
    inputs=(Input("voltage", "V", "zoh"),),
    outputs=(Output("position", "m"),),
    parameters=(
        Parameter("mass", "kg", nominal=50.0, lower=5.0, upper=500.0, scale="log"),
        Parameter("viscous", "N*s/m", nominal=100.0, lower=10.0, upper=1000.0, scale="log"),
        Parameter("dry", "N", nominal=10.0, lower=1.0, upper=100.0, scale="log"),
        Parameter("offset", "N", nominal=0.0, lower=-20.0, upper=20.0, minimum=-100.0),
    ),
    derivative=derivative,
)
