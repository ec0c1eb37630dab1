"""A drive whose current makes speed, against inertia and viscous friction; with dry friction, too.

``model`` lacks what the drive of friction.csv has, ``with_dry_friction`` does not.
"""

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.problem.shapes import dry_friction

CONSTANT = 0.05  # N*m/A, of the motor, from its data sheet


def viscous_only(x, u, p):
    inertia, viscous = p
    return ((CONSTANT * u[0] - viscous * x[0]) / inertia,)


def with_dry(x, u, p):
    inertia, viscous, dry = p
    return ((CONSTANT * u[0] - viscous * x[0] - dry * dry_friction(x[0], 0.05)) / inertia,)


def drive(derivative, *more):
    return ProcessModel(
        name="drive",
        states=(State("omega", "rad/s"),),
        inputs=(Input("current", "A", "zoh"),),
        outputs=(Output("omega", "rad/s"),),
        parameters=(
            Parameter("inertia", "kg*m^2", 1e-4, 1e-5, 1e-3, "log"),
            Parameter("viscous", "N*m*s/rad", 1e-4, 1e-5, 1e-2, "log"),
            *more,
        ),
        derivative=derivative,
    )


model = drive(viscous_only)
with_dry_friction = drive(with_dry, Parameter("dry", "N*m", 0.01, 1e-3, 0.1, "log"))
