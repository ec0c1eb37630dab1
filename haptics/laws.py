"""The laws of the torque controllers, sample by sample, in the one text that is run everywhere.

Plain scalar Python over flat arrays: Python runs it as it is, Numba compiles it, and
``sysid.engine.c_text`` makes C99 of it for a microcontroller. All memory is fixed.

s: the state (``STATES``), zero at first. c: constants (``CONSTANTS``), by their names below.
p: the model's parameters. ``acceleration`` and ``z_rate`` are the model's, see
``haptics.program``. The equations stand in ``haptics.allocation``, ``feedforward``, ``observer``
and ``lqg``.
"""

from collections.abc import MutableSequence
from typing import TYPE_CHECKING

Array = MutableSequence[float]

if TYPE_CHECKING:

    def acceleration(
        i_m: float, i_b: float, omega: float, z: float, theta: float, p: Array
    ) -> float:
        """The shaft's, without a hand [rad/s^2]."""

    def z_rate(omega: float, z: float, p: Array) -> float:
        """Rate of the hysteresis variable [1/s]."""


MOST_SUBSTEPS = 64
SUBSTEP = 0.5  # largest change of z, in parts of its range, by one Runge-Kutta step
BY_MOTOR, BY_HEATING, BY_STICTION = 0, 1, 2  # preferences

# Constants: of the allocation,
PREFERENCE, MOTOR_CONSTANT, R_MOTOR, R_BRAKE, MOTOR_LIMIT, BRAKE_LIMIT = 0, 1, 2, 3, 4, 5
# of the actuator and of time,
TIME, HORIZON, AHEAD, INERTIA, STIFFNESS = 6, 7, 8, 9, 10
MOTOR_GAIN, MOTOR_EMF, MOST_VOLTS, BRAKE_GAIN, BRAKE_DECAY, BRAKE_MEAN = 11, 12, 13, 14, 15, 16
# of the static law, of feedforward, of the regulator,
STANDSTILL, BRAKE_SLOPE, SHARE, SMOOTHING, LEAD = 17, 18, 19, 20, 21
# and of the shaft's filter x+ = A x + b N, x + L (y - C x), the regulator's gains, and the share of
# friction that is compensated: sliding, of that within the yield travel, and the z that slides.
FILTER_ORDER = 5
FILTER_A, FILTER_B, FILTER_L, REGULATOR = 22, 47, 52, 62
FRICTION, YIELD_SHARE, SLIDING = 83, 84, 85
# What a hand makes of a reference, see ``haptics.reference_shape``.
SHAPE_SLOPE, SHAPE_BEND, SHAPE_SMOOTHING, HAND_DAMPING, HAND_MEMORY = 86, 88, 90, 91, 92
HAND_DOUBT, HAND_RANGE = 93, 94
# The speed up to which friction is taken from the model.
FRICTION_SPEED, CONSTANTS = 95, 96

# States: of the filter,
ANGLE, SPEED, HAND, HAND_RATE, DISTURBANCE = 0, 1, 2, 3, 4
# the hysteresis, torque of motor and friction, whether a sample came, the brake's current,
Z, DRIVING, STARTED, BRAKE = 5, 6, 7, 8
# the last reference and whether there is one, the smoothed acceleration,
REFERENCE, REFERRED, SMOOTHED = 9, 10, 11
# what is predicted to when the command acts, currents that are coming, the regulator's answers.
NEXT_ANGLE, NEXT_SPEED, NEXT_Z, COMING, DELTAS = 12, 13, 14, 15, 36
# the reference's slope, slope and bend smoothed, the reference as shaped, and what tells the hand.
SLOPE, SHAPED_SLOPE, SHAPED_BEND, SHAPED, MOVED, FELT, STATES = 56, 57, 58, 59, 60, 61, 62


def static(
    theta: float, omega: float, sensed: float, i_m: float, reference: float,
    lost: int, s: Array, c: Array, p: Array, volts: Array,
) -> None:  # fmt: skip
    """Torque by constants."""
    slope = 0.0
    if abs(omega) > c[STANDSTILL]:
        slope = c[BRAKE_SLOPE] if omega > 0.0 else -c[BRAKE_SLOPE]
    i_b = brake_current(reference, slope, c)
    volts[0] = motor_current(reference - slope * i_b, c) / c[MOTOR_GAIN]
    volts[1] = i_b / c[BRAKE_GAIN]


def feedforward(
    theta: float, omega: float, sensed: float, i_m: float, reference: float,
    lost: int, s: Array, c: Array, p: Array, volts: Array,
) -> None:  # fmt: skip
    """The inverse: tau_r + k J domega/dt beside friction."""
    observe(theta, sensed, i_m, lost, s, c, p)
    look_ahead(s, c, p)
    slope = reference_slope(reference, lost, s, c)
    s[SMOOTHED] += c[SMOOTHING] * (shaft_acceleration(s, c) - s[SMOOTHED])
    wanted = reference + c[HORIZON] * slope + c[SHARE] * s[SMOOTHED]
    give(wanted, s, c, p, volts)


def lqg(
    theta: float, omega: float, sensed: float, i_m: float, reference: float,
    lost: int, s: Array, c: Array, p: Array, volts: Array,
) -> None:  # fmt: skip
    """The regulator on top of the inverse: tau_r + delta - d beside friction."""
    observe(theta, sensed, i_m, lost, s, c, p)
    look_ahead(s, c, p)
    before = s[SHAPED]
    if s[REFERRED] == 0.0:
        before = reference
    shaped = shape(reference, lost, s, c)
    slope = (shaped - before) / (c[TIME] * (1 + lost))
    delta = regulate(shaped + s[HAND], s[HAND_RATE] + slope, s, c)
    wanted = shaped + c[HORIZON] * slope + delta - s[DISTURBANCE]
    # What was given is what the next answer changes: nothing winds up.
    s[DELTAS + int(c[AHEAD]) - 1] += give(wanted, s, c, p, volts)


def brake_current(torque: float, slope: float, c: Array) -> float:
    """The brake's current [A] for a torque [N*m] at a slope [N*m/A]."""
    if c[PREFERENCE] == BY_MOTOR or torque * slope <= 0.0:
        return 0.0
    constant = c[MOTOR_CONSTANT]
    most = abs(constant) * c[MOTOR_LIMIT]
    # What is beyond the motor is the brake's under any preference. Where an ampere of it gives
    # less than one of the motor, it fades out: the current has no jump where b passes zero.
    reach = c[BRAKE_LIMIT] * min(abs(slope / constant), 1.0)
    least = 0.0
    if abs(torque) > most:
        least = min((abs(torque) - most) / abs(slope), reach)
    if c[PREFERENCE] == BY_STICTION:
        return least
    per_watt = constant * constant / c[R_MOTOR] + slope * slope / c[R_BRAKE]
    shared = torque / per_watt * slope / c[R_BRAKE]
    return min(max(shared, least), c[BRAKE_LIMIT])


def motor_current(torque: float, c: Array) -> float:
    """The motor's current [A] for what is left to it [N*m]."""
    return min(max(torque / c[MOTOR_CONSTANT], -c[MOTOR_LIMIT]), c[MOTOR_LIMIT])


def rest(i_b: float, omega: float, z: float, theta: float, c: Array, p: Array) -> float:
    """Torque of brake, friction and damping on the shaft [N*m]."""
    sure = min(max(omega, -c[FRICTION_SPEED]), c[FRICTION_SPEED])
    return c[INERTIA] * acceleration(0.0, i_b, sure, z, theta, p)


def turned(z: float, angle: float, time: float, c: Array, p: Array) -> float:
    """The hysteresis variable after the shaft has turned by an angle [rad] in a time [s]."""
    if angle == 0.0:
        return z
    omega = angle / time
    n = min(int(abs(angle) * c[STIFFNESS] / SUBSTEP) + 1, MOST_SUBSTEPS)
    step = time / n
    for _ in range(n):
        first = z_rate(omega, z, p)
        second = z_rate(omega, z + 0.5 * step * first, p)
        third = z_rate(omega, z + 0.5 * step * second, p)
        last = z_rate(omega, z + step * third, p)
        z = z + step / 6.0 * (first + 2.0 * (second + third) + last)
    return z


def observe(
    theta: float, sensed: float, i_m: float, lost: int, s: Array, c: Array, p: Array
) -> None:
    """To a sample of angle, torque sensor and motor current, behind so many that were lost."""
    for _ in range(lost):
        next_brake_current(s, c)
        coast(0.0, 0.0, s, c, p)
    next_brake_current(s, c)
    if s[STARTED] == 0.0:
        s[STARTED] = 1.0
        s[ANGLE] = theta
        return
    friction = rest(s[BRAKE], s[SPEED], s[Z], s[ANGLE], c, p)
    s[DRIVING] = c[MOTOR_CONSTANT] * i_m + friction
    guess_angle = c[FILTER_B] * s[DRIVING]
    guess_hand = c[FILTER_B + HAND] * s[DRIVING]
    for j in range(FILTER_ORDER):
        guess_angle += c[FILTER_A + j] * s[j]
        guess_hand += c[FILTER_A + FILTER_ORDER * HAND + j] * s[j]
    coast(theta - guess_angle, sensed - guess_hand, s, c, p)


def coast(angle: float, torque: float, s: Array, c: Array, p: Array) -> None:
    """The shaft a sample later, by how far angle [rad] and torque sensor [N*m] are off."""
    before = s[ANGLE]
    # Rows of A are upper triangular, so each may take the place of its state at once.
    for i in range(FILTER_ORDER):
        later = c[FILTER_B + i] * s[DRIVING]
        for j in range(i, FILTER_ORDER):
            later += c[FILTER_A + FILTER_ORDER * i + j] * s[j]
        s[i] = later
    for i in range(FILTER_ORDER):
        s[i] += c[FILTER_L + 2 * i] * angle + c[FILTER_L + 2 * i + 1] * torque
    s[Z] = turned(s[Z], s[ANGLE] - before, c[TIME], c, p)


def shaft_acceleration(s: Array, c: Array) -> float:
    """Of the shaft [rad/s^2]."""
    return (s[DRIVING] + s[HAND] + s[DISTURBANCE]) / c[INERTIA]


def look_ahead(s: Array, c: Array, p: Array) -> None:
    """The motion at the horizon, at the present acceleration."""
    rate, time = shaft_acceleration(s, c), c[HORIZON]
    angle = time * (s[SPEED] + 0.5 * time * rate)
    s[NEXT_ANGLE] = s[ANGLE] + angle
    s[NEXT_SPEED] = s[SPEED] + time * rate
    s[NEXT_Z] = turned(s[Z], angle, time, c, p)


def reference_slope(reference: float, lost: int, s: Array, c: Array) -> float:
    """By which the reference changes [N*m/s]."""
    slope = 0.0
    if s[REFERRED] != 0.0:
        slope = (reference - s[REFERENCE]) / (c[TIME] * (1 + lost))
    s[REFERRED] = 1.0
    s[REFERENCE] = reference
    return slope


def shape(reference: float, lost: int, s: Array, c: Array) -> float:
    """The reference by which this hand feels the reference [N*m]."""
    slope = reference_slope(reference, lost, s, c)
    bend = c[TIME] * (slope - s[SLOPE]) / (1 + lost)
    s[SLOPE] = slope
    s[SHAPED_SLOPE] += c[SHAPE_SMOOTHING] * (c[TIME] * slope - s[SHAPED_SLOPE])
    s[SHAPED_BEND] += c[SHAPE_SMOOTHING] * (bend - s[SHAPED_BEND])
    y = mobility(slope, s, c)
    s[SHAPED] = (
        reference
        + (c[SHAPE_SLOPE] + c[SHAPE_SLOPE + 1] * y) * s[SHAPED_SLOPE]
        + (c[SHAPE_BEND] + c[SHAPE_BEND + 1] * y) * s[SHAPED_BEND]
    )
    return s[SHAPED]


def mobility(slope: float, s: Array, c: Array) -> float:
    """Of the hand, in parts of the design's: by what moves and what is felt along the slope."""
    turned = c[HAND_DAMPING] * shaft_acceleration(s, c)
    s[MOVED] += c[HAND_MEMORY] * (slope * turned - s[MOVED])
    s[FELT] += c[HAND_MEMORY] * (slope * (turned - s[HAND_RATE]) - s[FELT])
    y = (max(s[MOVED], 0.0) + c[HAND_DOUBT]) / (max(s[FELT], 0.0) + c[HAND_DOUBT])
    return min(max(y, 1.0 / c[HAND_RANGE]), c[HAND_RANGE])


def give(wanted: float, s: Array, c: Array, p: Array, volts: Array) -> float:
    """Commands [V] for a torque on the shaft beside friction; what limits add to it [N*m]."""
    omega, z, theta = s[NEXT_SPEED], s[NEXT_Z], s[NEXT_ANGLE]
    without = rest(0.0, omega, z, theta, c, p)
    per_ampere = rest(1.0, omega, z, theta, c, p) - without
    needed = wanted - friction_share(z, c) * without
    i_b = brake_current(needed, per_ampere, c)
    from_brake = per_ampere * mean_brake_current(i_b, s, c)
    i_m = motor_current(needed - from_brake, c)
    motor = (i_m - c[MOTOR_EMF] * omega) / c[MOTOR_GAIN]
    volts[0] = min(max(motor, -c[MOST_VOLTS]), c[MOST_VOLTS])
    volts[1] = i_b / c[BRAKE_GAIN]
    return c[MOTOR_CONSTANT] * i_m + from_brake - needed


def friction_share(z: float, c: Array) -> float:
    """Of the friction that is taken off, scheduled by how far the hysteresis has yielded."""
    yielded = min(abs(z) / c[SLIDING], 1.0)
    return c[FRICTION] * (c[YIELD_SHARE] + (1.0 - c[YIELD_SHARE]) * yielded)


def next_brake_current(s: Array, c: Array) -> None:
    """The brake's current at the next sample, a first-order lag behind what is asked for."""
    s[BRAKE] = s[COMING] + (s[BRAKE] - s[COMING]) * c[BRAKE_DECAY]
    for k in range(int(c[AHEAD])):
        s[COMING + k] = s[COMING + k + 1]


def mean_brake_current(target: float, s: Array, c: Array) -> float:
    """The mean current while the command holds that asks for a current [A]."""
    ahead = int(c[AHEAD])
    s[COMING + ahead] = target
    current = s[BRAKE]
    for k in range(ahead):
        current = s[COMING + k] + (current - s[COMING + k]) * c[BRAKE_DECAY]
    return target + (current - target) * c[BRAKE_MEAN]


def regulate(missing: float, rate: float, s: Array, c: Array) -> float:
    """The next delta [N*m]: by e [N*m] and w + tau_r' [N*m/s]."""
    target = c[LEAD] * rate
    ahead = int(c[AHEAD])
    change = c[REGULATOR] * missing
    for k in range(ahead):
        change += c[REGULATOR + 1 + k] * (s[DELTAS + k] - target)
    delta = s[DELTAS + ahead - 1] - change
    for k in range(ahead - 1):
        s[DELTAS + k] = s[DELTAS + k + 1]
    s[DELTAS + ahead - 1] = delta
    return delta
