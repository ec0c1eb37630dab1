"""A rig's physics from first principles, apart from the simulated rig's: motor, brake, load.

One shaft carries the motor, the brake and the load; positive currents turn it forwards. Both
amplifiers are transconductance amplifiers on a supply of limited voltage:

    L di/dt = v - R i - K omega,  v so that tau di/dt = gain u - i, within the supply.

The brake is a magnetorheological clutch against the housing, a Coulomb friction with a presliding
stiffness (Dahl): torque (residual + constant |i_b|) z + damping omega, dz/dt = sigma (omega -
|omega| z). Everything else is one inertia and the load's torque.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

COUNTS = 8192  # a turn, of 2048 cycles
SUBSTEP = 8e-5  # s, the longest step of the integration
GRAVITY = 9.81

FREE, PULLEY, LOCKED, HAND = LOADS = ("free", "pulley", "locked", "hand")

# Places in the state.
I_MOTOR, I_BRAKE, OMEGA, THETA, Z, HEIGHT, LIFT = range(7)


class Parameters(NamedTuple):
    """Physical parameters, SI units; drawn by ``draw``."""

    resistance_motor: float
    inductance_motor: float
    response_motor: float  # time constant of the current
    gain_motor: float  # A/V
    constant_motor: float  # N*m/A
    resistance_brake: float
    inductance_brake: float
    response_brake: float
    gain_brake: float
    constant_brake: float  # N*m/A
    residual_brake: float  # N*m
    stiffness: float  # sigma, 1/rad
    damping_motor: float
    damping_brake: float
    inertia_motor: float
    inertia_brake: float
    inertia_load: float
    supply: float  # V
    most_current: float  # A that the motor's amplifier gives
    mass: float  # kg on the cable; 0: no cable
    radius: float  # m
    cable: float  # N/m
    loss: float  # N*s/m of the cable
    locked: bool


class Grip(NamedTuple):
    """A hand: stiffness and damping between the shaft and a wrist that moves as it will."""

    stiffness: float  # N*m/rad
    damping: float
    angle: float  # rad
    rate: float  # rad/s


LET_GO = Grip(0.0, 0.0, 0.0, 0.0)


class Advance(NamedTuple):
    """What happened in one tick: energy from the supply [J], peaks in magnitude."""

    energy: float
    omega: float
    current_motor: float
    current_brake: float


def draw(seed, load=FREE):
    """Parameters of one rig of many; seed 0 is the one in the middle.

    Electronics vary by a data sheet's tolerance, mechanics by a third.
    """
    rng = np.random.default_rng(seed)

    def near(value, spread):
        return value * math.exp(spread * rng.uniform(-1.0, 1.0)) if seed else value

    mass = near(0.09, 0.2)
    return Parameters(
        resistance_motor=near(1.2, 0.2),
        inductance_motor=near(1.2e-3, 0.3),
        response_motor=near(8e-4, 0.3),
        gain_motor=near(0.5, 0.03),
        constant_motor=near(0.141, 0.1),
        resistance_brake=near(120.0, 0.04),
        inductance_brake=near(0.2, 0.3),
        response_brake=near(5e-3, 0.3),
        gain_brake=near(0.5, 0.03),
        constant_brake=near(3.5, 0.15),
        residual_brake=near(0.018, 0.2),
        stiffness=near(45.0, 0.3),
        damping_motor=near(8e-5, 0.5),
        damping_brake=near(1.5e-4, 0.5),
        inertia_motor=near(7e-5, 0.2),
        inertia_brake=near(3.2e-5, 0.2),
        inertia_load=near(4e-6, 0.5),
        supply=24.0,
        most_current=2.5,
        mass=mass if load == PULLEY else 0.0,
        radius=0.01,
        cable=near(2000.0, 0.3),
        loss=near(6.0, 0.3),
        locked=load == LOCKED,
    )


@numba.njit(cache=True)
def _winding(current, back, resistance, inductance, response, target, supply):
    """Voltage at a winding, and the rate of its current [A/s]."""
    wanted = resistance * current + back + inductance * (target - current) / response
    volts = min(max(wanted, -supply), supply)
    return volts, (volts - resistance * current - back) / inductance


@numba.njit(cache=True)
def _load(x, p, grip):
    """Torque of load and hand on the shaft, and the tension of the cable [N]."""
    torque = grip.stiffness * (grip.angle - x[THETA]) + grip.damping * (grip.rate - x[OMEGA])
    tension = 0.0
    if p.mass > 0.0:
        side = 1.0 if x[THETA] >= 0.0 else -1.0  # the cable winds up either way
        stretch = p.radius * side * x[THETA] - x[HEIGHT]
        if stretch > 0.0:
            speed = p.radius * side * x[OMEGA] - x[LIFT]
            tension = max(0.0, p.cable * stretch + p.loss * speed)
        torque -= p.radius * side * tension
    return torque, tension


@numba.njit(cache=True)
def _acceleration(x, p, load):
    """Angular acceleration, motor torque and the brake's."""
    motor = p.constant_motor * x[I_MOTOR] - p.damping_motor * x[OMEGA]
    brake = (p.residual_brake + p.constant_brake * abs(x[I_BRAKE])) * x[Z]
    brake += p.damping_brake * x[OMEGA]
    inertia = p.inertia_motor + p.inertia_brake + p.inertia_load
    alpha = 0.0 if p.locked else (motor - brake + load) / inertia
    return alpha, motor, brake


@numba.njit(cache=True)
def _derivative(x, p, motor, brake, grip, out):
    """State's rate into ``out``; the power from the supply [W]."""
    target = min(max(p.gain_motor * motor, -p.most_current), p.most_current)
    back = p.constant_motor * x[OMEGA]
    volts_motor, out[I_MOTOR] = _winding(
        x[I_MOTOR], back, p.resistance_motor, p.inductance_motor, p.response_motor,
        target, p.supply,
    )  # fmt: skip
    volts_brake, out[I_BRAKE] = _winding(
        x[I_BRAKE], 0.0, p.resistance_brake, p.inductance_brake, p.response_brake,
        p.gain_brake * brake, p.supply,
    )  # fmt: skip
    load, tension = _load(x, p, grip)
    alpha, _, _ = _acceleration(x, p, load)
    out[OMEGA] = alpha
    out[THETA] = x[OMEGA]
    out[Z] = p.stiffness * (x[OMEGA] - abs(x[OMEGA]) * x[Z])
    out[HEIGHT] = out[LIFT] = 0.0
    if p.mass > 0.0:
        out[HEIGHT] = x[LIFT]
        out[LIFT] = tension / p.mass - GRAVITY
    return max(0.0, volts_motor * x[I_MOTOR]) + max(0.0, volts_brake * x[I_BRAKE])


@numba.njit(cache=True)
def _edges(edge, before, after, start, step):
    """Follow the counter over a substep: its count, and the rate from its last two edges.

    edge: count, time of the last edge [s], rate [1/s]; written.
    """
    count = math.floor(after)
    moved = count - edge[0]
    if moved == 0.0:
        # No edge for so long: slower than a count in that time.
        waited = start + step - edge[1]
        most = 1.0 / waited if waited > 0.0 else math.inf
        edge[2] = min(max(edge[2], -most), most)
        return
    place = count if moved > 0.0 else count + 1.0  # where the last edge stands
    when = start + step * (place - before) / (after - before)
    waited = when - edge[1]
    turned_round = moved * edge[3] < 0.0  # the same edge a second time: no way between the two
    edge[2] = (moved - math.copysign(1.0, moved) * turned_round) / waited if waited > 0.0 else 0.0
    edge[0], edge[1], edge[3] = count, when, moved


@numba.njit(cache=True)
def _along(x, h, rate, out):
    for place in range(len(x)):
        out[place] = x[place] + h * rate[place]
    return out


@numba.njit(cache=True)
def _advance(x, edge, p, motor, brake, grip, start, seconds):
    steps = math.ceil(seconds / SUBSTEP)
    h = seconds / steps
    k1, k2, k3, k4, y = np.empty(7), np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    energy = omega = current_motor = current_brake = 0.0
    per_radian = COUNTS / (2.0 * math.pi)
    for step in range(steps):
        before = x[THETA] * per_radian
        power = _derivative(x, p, motor, brake, grip, k1)
        _derivative(_along(x, 0.5 * h, k1, y), p, motor, brake, grip, k2)
        _derivative(_along(x, 0.5 * h, k2, y), p, motor, brake, grip, k3)
        _derivative(_along(x, h, k3, y), p, motor, brake, grip, k4)
        for place in range(7):
            x[place] += h / 6.0 * (k1[place] + 2.0 * (k2[place] + k3[place]) + k4[place])
        for place in (I_MOTOR, I_BRAKE):
            if abs(x[place]) < 1e-12:  # A; numbers this small only cost time
                x[place] = 0.0
        if p.locked:
            x[OMEGA] = 0.0
        energy += h * power
        omega = max(omega, abs(x[OMEGA]))
        current_motor = max(current_motor, abs(x[I_MOTOR]))
        current_brake = max(current_brake, abs(x[I_BRAKE]))
        _edges(edge, before, x[THETA] * per_radian, start + step * h, h)
    return energy, omega, current_motor, current_brake


@numba.njit(cache=True)
def _torques(x, p, grip):
    load, _ = _load(x, p, grip)
    alpha, motor, _ = _acceleration(x, p, load)
    return motor - p.inertia_motor * alpha, load - p.inertia_load * alpha


class Plant:
    """The state of a rig, advanced tick by tick.

    parameters: may be replaced at any time. grip: the hand's. state: by the places above.
    """

    def __init__(self, parameters, load=FREE):
        self.parameters = parameters
        self.load = load
        self.grip = LET_GO
        self.time = 0.0  # s
        self.state = np.zeros(7)
        if parameters.mass > 0.0:
            self.state[HEIGHT] = -parameters.mass * GRAVITY / parameters.cable
        self._edge = np.array([0.0, 0.0, 0.0, 0.0])

    def advance(self, motor, brake, seconds):
        """So many seconds with these volts at the amplifiers; an Advance."""
        peaks = _advance(
            self.state, self._edge, self.parameters, motor, brake, self.grip, self.time, seconds
        )
        self.time += seconds
        return Advance(*peaks)

    def torque(self, sensor):
        """At the sensor ``between`` motor and brake or at the ``load`` [N*m]."""
        between, at_load = _torques(self.state, self.parameters, self.grip)
        return between if sensor == "between" else at_load

    @property
    def count(self):
        """Of the quadrature counter."""
        return self._edge[0]

    @property
    def count_rate(self):
        """By the time between the last two edges [1/s]."""
        return self._edge[2]
