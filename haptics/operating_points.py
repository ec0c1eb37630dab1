"""The family of linear models of an actuator: by direction, brake current and hysteresis.

What differs between the points is the brake: within its yield travel it is a spring,
alpha(i) dz/dtheta, sliding a small damper. Each point has the whole linear model, from the commands
and the hand's torque.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from daq.torque import OperatingPoint
from haptics.dynamics import CURRENTS, SHAFT, ActuatorDynamics
from sysid import LinearModel, ProcessModel
from sysid.arrays import FloatArray

BRAKE_CURRENTS = (0.0, 0.05, 0.1, 0.18)  # A
_SPEED = 1.0  # rad/s, of a sliding shaft

Branch = Literal["within yield", "sliding forwards", "sliding backwards"]
_BRANCHES: dict[Branch, float] = {
    "within yield": 0.0,
    "sliding forwards": 1.0,
    "sliding backwards": -1.0,
}


def operating_points(
    model: ProcessModel,
    parameters: FloatArray | None = None,
    brake_currents: Sequence[float] = BRAKE_CURRENTS,
) -> tuple[OperatingPoint, ...]:
    """Every branch of the hysteresis at each brake current [A].

    model: as for ``ActuatorDynamics``. parameters: (n_parameters,), default nominal. Raises
    ModelError.

    >>> from sim_rig.actuator import actuator
    >>> points = operating_points(actuator(parameters="rig"), brake_currents=[0.1])
    >>> [(point.branch, round(point.stiffness, 1)) for point in points]
    [('within yield', 17.4), ('sliding forwards', 0.0), ('sliding backwards', 0.0)]
    """
    dynamics = ActuatorDynamics(model, parameters)
    return tuple(
        operating_point(dynamics, branch, current)
        for current in brake_currents
        for branch in _BRANCHES
    )


def operating_point(dynamics: ActuatorDynamics, branch: Branch, current: float) -> OperatingPoint:
    """One point of the family, at a brake current [A]."""
    names, inputs = dynamics.model.state_names, dynamics.model.input_names
    direction = _BRANCHES[branch]
    A, B, _, _ = dynamics.linear(direction * _SPEED, direction * dynamics.sliding, current)
    omega, z, theta = (names.index(name) for name in SHAFT)
    along_z = dynamics.inertia * A[omega, z]
    # At a speed dz/dt is -lambda (z - z_slide): a spring only as far as z follows the angle.
    stiffness = -along_z * A[z, omega] - dynamics.inertia * A[omega, theta]
    damping = -dynamics.inertia * A[omega, omega]
    outputs = (*CURRENTS, "omega", "theta")
    C = np.eye(len(names))[[names.index(name) for name in outputs]]
    linear = LinearModel(A, B, C, np.zeros((len(outputs), len(inputs))))
    return OperatingPoint(
        branch, current, round(float(stiffness), 6), float(damping), linear, names, inputs, outputs
    )
