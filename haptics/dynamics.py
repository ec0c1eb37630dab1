"""The actuator's dynamics as its torque controllers need them, from any process model of it.

All is read from the model's own equations, so that every combination of drivers, hysteresis and
friction is controlled by what was identified:

    J domega/dt = K_t i_m + rest(omega, z, theta, i_b) + tau_u

with tau_u the hand's torque on the shaft; the hand feels -tau_u. The electrical half is linear but
for the back EMF, and fast beside a sample: of it a channel's gain at rest and its mean delay count.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid import LinearModel, ModelError, ProcessModel, linearize
from sysid.arrays import FloatArray

INPUTS = ("applied_voltage_motor", "applied_voltage_brake", "torque")
SHAFT = ("omega", "z", "theta")
CURRENTS = ("current_motor", "current_brake")

_TURNS = 1.0  # rad that a shaft turns until its hysteresis surely slides
_BISECTIONS = 45


@dataclass(frozen=True)
class Channel:
    """One amplifier with its winding: amperes per volt at rest, and the mean delay of them [s].

    emf: amperes per rad/s that the back EMF adds, zero for a brake.
    """

    gain: float
    delay: float
    emf: float


class ActuatorDynamics:
    """Numbers and functions of one actuator.

    model: a process model with the states and inputs of the ``actuator`` under a measured load.
    parameters: (n_parameters,), default the model's nominal ones. Raises ModelError for a model
    that is none of an actuator, or whose currents do not settle.

    >>> from sim_rig.actuator import actuator
    >>> dynamics = ActuatorDynamics(actuator(parameters="rig"))
    >>> round(dynamics.motor_constant, 4), round(dynamics.inertia * 1e6)
    (0.1412, 102)
    """

    def __init__(self, model: ProcessModel, parameters: FloatArray | None = None) -> None:
        for kind, needed, names in (
            ("state", (*CURRENTS, *SHAFT), model.state_names),
            ("input", INPUTS, model.input_names),
        ):
            missing = [name for name in needed if name not in names]
            if missing:
                raise ModelError(
                    f"model {model.name} has no {kind} {', '.join(missing)}: torque is controlled "
                    "by a model of the actuator whose load is measured"
                )
        self.model = model
        self.parameters = model.nominal if parameters is None else np.asarray(parameters)
        self._derivative = model.derivative
        self._p = tuple(self.parameters.tolist())
        self._zeros = [0.0] * len(model.states)
        order = [model.input_names.index(name) for name in INPUTS]
        self._no_load = (0.0,) * len(order)
        unit = [0.0] * len(order)
        unit[order[2]] = 1.0
        self._omega, self._z, self._theta = (model.state_names.index(name) for name in SHAFT)
        self._i_m, self._i_b = (model.state_names.index(name) for name in CURRENTS)
        loaded = self._derivative(tuple(self._zeros), tuple(unit), self._p)[self._omega]
        self.inertia: float = 1.0 / (loaded - self._slopes(0.0, 0.0, 0.0, 0.0, 0.0)[self._omega])
        self.motor_constant = self.torque(1.0, 0.0, 0.0, 0.0, 0.0) - self.torque(
            0.0, 0.0, 0.0, 0.0, 0.0
        )

    def torque(self, i_m: float, i_b: float, omega: float, z: float, theta: float) -> float:
        """Torque of motor, brake and friction on the shaft [N*m]."""
        acceleration: float = self._slopes(i_m, i_b, omega, z, theta)[self._omega]
        return self.inertia * acceleration

    def rest(self, i_b: float, omega: float, z: float, theta: float) -> float:
        """The same without the motor's: brake, friction and viscous damping [N*m]."""
        return self.torque(0.0, i_b, omega, z, theta)

    def brake_slope(self, omega: float, z: float, theta: float) -> float:
        """Torque on the shaft that an ampere of the brake's adds as its hysteresis is [N*m/A]."""
        return self.rest(1.0, omega, z, theta) - self.rest(0.0, omega, z, theta)

    @cached_property
    def sliding(self) -> float:
        """The hysteresis variable at which a shaft that turns forwards slides."""
        # From z = 0 on, in steps of a milliradian within the yield travel, then by bisection.
        low, step = 0.0, 1e-3 * self._z_rate(1.0, 0.0)
        for _ in range(int(_TURNS / 1e-3)):
            if self._z_rate(1.0, low + step) <= 0.0:
                break
            low += step
        for _ in range(_BISECTIONS):
            step *= 0.5
            if self._z_rate(1.0, low + step) > 0.0:
                low += step
        return low

    @cached_property
    def stiffness(self) -> float:
        """dz/dtheta at z = 0 in parts of the z that slides [1/rad]: inverse of the yield travel."""
        return abs(self._z_rate(1.0, 0.0) / self.sliding)

    @property
    def resistances(self) -> tuple[float, float]:
        """Of the windings of motor and brake [ohm]."""
        values = dict(zip(self.model.parameter_names, self._p, strict=True))
        try:
            return values["R_m"], values["R_b"]
        except KeyError as error:
            raise ModelError(f"model {self.model.name} has no resistance {error}") from None

    @cached_property
    def motor(self) -> Channel:
        """The motor's channel."""
        return self._channel("current_motor", "applied_voltage_motor")

    @cached_property
    def brake(self) -> Channel:
        """The brake's channel."""
        return self._channel("current_brake", "applied_voltage_brake")

    def linear(self, omega: float, z: float, i_b: float) -> LinearModel:
        """dx/dt = A x + B u of all states at a speed, a hysteresis variable, a brake current."""
        x = self._state(0.0, i_b, omega, z, 0.0)
        return linearize(self.model, np.array(x), np.zeros(len(self.model.inputs)), self.parameters)

    def _z_rate(self, omega: float, z: float) -> float:
        """dz/dt at a speed."""
        rate: float = self._slopes(0.0, 0.0, omega, z, 0.0)[self._z]
        return rate

    def _channel(self, current: str, command: str) -> Channel:
        A, B, _, _ = self.linear(0.0, 0.0, 0.0)
        names = self.model.state_names
        electrical = [i for i, name in enumerate(names) if name not in SHAFT]
        inner = A[np.ix_(electrical, electrical)]
        place = electrical.index(names.index(current))
        if not np.all(np.linalg.eigvals(inner).real < 0.0):
            raise ModelError(
                f"with these parameters the currents of model {self.model.name} do not settle; "
                "identify it again, or check the drivers' parameters"
            )
        once = np.linalg.solve(inner, B[electrical, self.model.input_names.index(command)])
        emf = -np.linalg.solve(inner, A[electrical, self._omega])[place]
        gain = -once[place]
        # G(s) = G(0) (1 - s delay + ...)
        delay = np.linalg.solve(inner, once)[place] / gain
        return Channel(float(gain), float(delay), float(emf))

    def _state(
        self, i_m: float, i_b: float, omega: float, z: float, theta: float
    ) -> tuple[float, ...]:
        x = self._zeros.copy()
        x[self._i_m], x[self._i_b] = i_m, i_b
        x[self._omega], x[self._z], x[self._theta] = omega, z, theta
        return tuple(x)

    def _slopes(
        self, i_m: float, i_b: float, omega: float, z: float, theta: float
    ) -> tuple[float, ...]:
        x = self._state(i_m, i_b, omega, z, theta)
        slopes: tuple[float, ...] = self._derivative(x, self._no_load, self._p)
        return slopes
