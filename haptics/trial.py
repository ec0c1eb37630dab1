"""A trial: a controller on one plausible actuator in a hand, with what lies between them.

In the manner of ``haptics.laws``, run as machine code: sampling, the delay of the answer, the
encoder's counts, noise of the sensors, clamps of the commands, and limits that end a run.
``answer`` stands for the law, ``advance`` is the model's step.
"""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from haptics.laws import feedforward as answer
    from haptics.model_step import advance, hand_torque

# Of a wall: its stiffness and damping, position, brake command [V] in contact, gains of the
# tracker of speed, tap and its first and last sample, soft stiffness and damping, leaving speed.
STIFF, DAMP, POSITION, CONTACT, ALPHA, BETA, TAP, TAP_FROM, TAP_TO = 0, 1, 2, 3, 4, 5, 6, 7, 8
SOFT, SOFT_DAMP, LEAVE, WALL = 9, 10, 11, 12
# Of limits: currents, speed, torque; lowest and highest commands.
MOTOR_TRIP, BRAKE_TRIP, SPEED_TRIP, TORQUE_TRIP, LOW_M, HIGH_M, LOW_B, HIGH_B = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
)
# Of the result: which limit tripped first, from 1, and when; largest of all; rms speed at the end
# [rad/s]; whether the wall was left.
TRIPPED, WHEN, MOST, AT_REST, LEFT, RESULT = 0, 1, 2, 6, 7, 8


def trial(
    reference: Any, share: Any, path: Any, noise: Any, wall: Any, walled: bool, limits: Any,
    count: float, ahead: int, last: int, places: Any, steps: int, time: float,
    s: Any, c: Any, p: Any, q: Any, m: Any, x: Any, u: Any, hand: Any, w: Any,
    queue: Any, result: Any,
) -> None:  # fmt: skip
    """All samples of a reference, (n,) [N*m], and of the hand's path, (n + 1,) [rad].

    noise: (n, 3), of motor and brake current [A] and of the torque sensor [N*m]. last: samples at
    the end over which the shaft is to be at rest. places: of omega, theta and
    the currents among the states, of commands and torque among the inputs. q: parameters of the
    actuator. w: (6, n_states), queue: (ahead + 1, 2), to work in.
    """
    omega, theta, i_m, i_b = places[0], places[1], places[2], places[3]
    motor, brake, load = places[4], places[5], places[6]
    n, volts = len(reference), queue[ahead]
    angle, speed, swing = x[theta], 0.0, 0.0
    stiff, damp, left = wall[STIFF], wall[DAMP], False
    for k in range(n):
        hand[2] = path[k]
        hand[3] = (path[k + 1] - path[k]) / time
        push = hand_torque(x[omega], x[theta], hand)
        seen = (
            abs(x[i_m] + noise[k, 0]),
            abs(x[i_b] + noise[k, 1]),
            abs(x[omega]),
            abs(push + noise[k, 2]),
        )
        for j in range(4):
            result[MOST + j] = max(result[MOST + j], seen[j])
            if not seen[j] <= limits[j]:
                result[TRIPPED] = j + 1.0
                result[WHEN] = k * time
                return
        measured = math.floor(x[theta] / count) * count
        torque = reference[k]
        depth = 0.0
        if walled:
            angle += time * speed
            missed = measured - angle
            angle += wall[ALPHA] * missed
            speed += wall[BETA] * missed
            depth = measured - wall[POSITION]
            if abs(speed) > wall[LEAVE] and k > wall[TAP_FROM]:
                stiff, damp, left = wall[SOFT], wall[SOFT_DAMP], True
            if depth > 0.0:
                ramp = min(1.0, k / wall[TAP_FROM])
                K = wall[SOFT] + ramp * (stiff - wall[SOFT])
                B = wall[SOFT_DAMP] + ramp * (damp - wall[SOFT_DAMP])
                torque -= K * depth + B * speed
            if k >= wall[TAP_FROM] and k < wall[TAP_TO] and not left:
                torque += wall[TAP]
        for j in range(ahead):
            queue[j, 0] = queue[j + 1, 0]
            queue[j, 1] = queue[j + 1, 1]
        answer(
            measured, x[omega], push + noise[k, 2], x[i_m] + noise[k, 0], torque, 0, s, c, p, volts
        )
        if depth > 0.0:
            volts[1] = max(volts[1], wall[CONTACT])
        volts[0] = min(max(share[k] * volts[0], limits[LOW_M]), limits[HIGH_M])
        volts[1] = min(max(share[k] * volts[1], limits[LOW_B]), limits[HIGH_B])
        u[motor] = queue[0, 0]
        u[brake] = queue[0, 1]
        u[load] = 0.0
        advance(
            x, u, q, m, hand, len(x), steps, time, omega, theta, load,
            w[0], w[1], w[2], w[3], w[4], w[5],
        )  # fmt: skip
        if k >= n - last:
            swing += x[omega] * x[omega]
    result[AT_REST] = math.sqrt(swing / last)
    if left:
        result[LEFT] = 1.0
