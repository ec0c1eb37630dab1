"""What hangs on the shaft: nothing, a lock, a mass on a pulley, a hand, or a measured torque."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sim_rig.physics.options import Load
from sim_rig.physics.parameters import fixed
from sysid import Input, ModelError, Parameter, ProcessModel, State

GRAVITY = 9.80665  # m/s^2
_CROSSOVER = 0.1  # rad in which a cable wound off changes sides, about as it leaves a small drum

# A hand (A.2): it responds in 0.237 s, with 0.707 of critical damping, and has an inertia an order
# of magnitude above the rotors.
_HAND_FREQUENCY = 3.0 / 0.237  # rad/s
_HAND_INERTIA = 1e-3  # kg*m^2
HAND_STIFFNESS = _HAND_FREQUENCY**2 * _HAND_INERTIA  # N*m/rad
HAND_DAMPING = 2.0 * 0.707 * _HAND_FREQUENCY * _HAND_INERTIA  # N*m*s/rad

_INERTIA = 1e-6  # kg*m^2, of the pulley; assumed: small, of aluminium
_MASS = 0.25  # kg, the lab's 250 g
_CABLE = 5000.0  # N/m, assumed: thin braided cable, half a metre


@dataclass(frozen=True)
class LoadModel:
    """A load's states, inputs, parameters and equation.

    torque: (theta, omega, x, u, p) -> (torque on the shaft, rates of its own states...), each
    of its own. inertia: of what turns with the shaft, from its parameters.
    """

    torque: Callable[[Any, Any, Any, Any, Any], tuple[Any, ...]]
    states: tuple[State, ...] = ()
    inputs: tuple[Input, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    inertia: Callable[[Any], Any] = lambda p: 0.0


def _combined(first: LoadModel, second: LoadModel) -> LoadModel:
    """Two loads on one shaft."""
    n, m, q = len(first.states), len(first.inputs), len(first.parameters)
    first_torque, second_torque = first.torque, second.torque
    first_inertia, second_inertia = first.inertia, second.inertia

    def torque(theta: Any, omega: Any, x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        from_first = first_torque(theta, omega, x[:n], u[:m], p[:q])
        from_second = second_torque(theta, omega, x[n:], u[m:], p[q:])
        return (from_first[0] + from_second[0], *from_first[1:], *from_second[1:])

    return LoadModel(
        torque,
        first.states + second.states,
        first.inputs + second.inputs,
        first.parameters + second.parameters,
        lambda p: first_inertia(p[:q]) + second_inertia(p[q:]),
    )


def pulley_torque(theta: Any, omega: Any, x: Any, u: Any, p: Any) -> tuple[Any, Any, Any]:
    """Torque of a mass on a cable [N*m], and the rates of its height [m] and speed [m/s].

    The cable pulls and never pushes: beyond slack it carries nothing. It is a spring whose loss
    grows with its tension (Hunt & Crossley, "Coefficient of restitution interpreted as damping
    in vibroimpact", Journal of Applied Mechanics 42, 1975), so that the tension has no jump
    where the cable comes taut. Wound off past its end it winds up on the other side; wound up to
    its length, the mass meets the pulley and stops. height is zero where the wound-off cable
    would just be taut.
    """
    height, speed = x
    mass, radius, _J_p, stiffness, loss, length = p
    root = math.sqrt(theta * theta + _CROSSOVER * _CROSSOVER)
    lever = radius * theta / root
    stretch = max(radius * (root - _CROSSOVER) - height, 0.0)
    tension = stiffness * stretch * max(1.0 + loss * (lever * omega - speed), 0.0)
    pressed = max(height - length, 0.0)
    stop = stiffness * pressed * max(1.0 + loss * speed, 0.0)
    return -tension * lever, speed, (tension - stop) / mass - GRAVITY


def wound_up(model: ProcessModel, turns: float) -> dict[str, float]:
    """Where states of an actuator start whose brake holds a load that was wound up.

    What the brake's friction holds depends on its parameters, and too much of it would push: it
    starts without any, and takes the load within its first degrees. Raises ModelError for a load
    without a cable.
    """
    values = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    if "k_cable" not in values:
        raise ModelError(f"turns: {turns:g} are wound up of a load that has no cable; load: pulley")
    theta = 2.0 * math.pi * turns
    length = values["radius"] * (math.hypot(theta, _CROSSOVER) - _CROSSOVER)
    height = length - values["mass"] * GRAVITY / values["k_cable"]
    return {"theta": theta, "height": height, "z": 0.0}


def hand_torque(theta: Any, omega: Any, x: Any, u: Any, p: Any) -> tuple[Any]:
    """Torque of a hand's impedance on the shaft (A.1) [N*m]; its wrist moves as it will."""
    grip, hand_theta, hand_omega = u
    K_u, B_u = p
    return (grip * (B_u * (hand_omega - omega) + K_u * (hand_theta - theta)),)


_FREE = LoadModel(lambda theta, omega, x, u, p: (0.0,))

_MEASURED = LoadModel(
    lambda theta, omega, x, u, p: (u[0],),
    inputs=(
        Input("torque", "N*m", "foh", "load torque on the shaft, as measured", ("omega", _INERTIA)),
    ),
)

_PULLEY = LoadModel(
    pulley_torque,
    (
        State("height", "m", -_MASS * GRAVITY / _CABLE, "of the hanging mass, cable stretched"),
        State("speed", "m/s", 0.0, "of the hanging mass"),
    ),
    (),
    (
        fixed("mass", "kg", _MASS, "hanging mass"),
        fixed("radius", "m", 0.005, "of the pulley; assumed: the brake's residual holds the load"),
        fixed("J_p", "kg*m^2", _INERTIA, "pulley inertia; assumed: small, of aluminium"),
        fixed("k_cable", "N/m", _CABLE, "stiffness; assumed: thin braided cable, half a metre"),
        fixed("d_cable", "s/m", 4.0, "loss; assumed: a seventh of critical under the mass"),
        fixed("length", "m", 0.5, "of cable that can be wound; assumed: sixteen turns"),
    ),
    lambda p: p[2],
)

_HAND = LoadModel(
    hand_torque,
    (),
    (
        Input("hand_grip", "1", "zoh", "1 while a hand holds the handle, else 0"),
        Input("hand_theta", "rad", "foh", "angle of the wrist"),
        Input("hand_omega", "rad/s", "foh", "speed of the wrist"),
    ),
    (
        fixed("K_u", "N*m/rad", HAND_STIFFNESS, "stiffness of the hand (A.2)"),
        fixed("B_u", "N*m*s/rad", HAND_DAMPING, "damping of the hand (A.2)"),
    ),
)

LOADS: dict[Load, LoadModel] = {
    "measured": _MEASURED,
    "free": _FREE,
    "locked": _FREE,  # carries nothing but what holds it
    "pulley": _PULLEY,
    "hand": _HAND,
    "pulley+hand": _combined(_PULLEY, _HAND),
}
