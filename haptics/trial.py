"""Trials: a controller on plausible actuators in hands, with what lies between them.

In the manner of ``haptics.laws``, run as machine code: sampling, the delay of the answer, the
encoder's counts, noise of the sensors, clamps of the commands, and limits that end a run. The
plants are lanes of one kernel, so that all of them advance at vector speed; what senses and answers
goes lane by lane. ``answer`` stands for the law, ``next_sample`` is the plants' kernel, of
``sysid.engine.sample_kernel``.
"""

import math
from typing import TYPE_CHECKING, Any

from sysid.engine.scheme import LANES

if TYPE_CHECKING:
    from haptics.laws import feedforward as answer

    def next_sample(plant: Any, inputs: Any, step: float, n_steps: int) -> None:
        """The plants a sample later."""


# Of a wall: its stiffness and damping, position, brake command [V] in contact, gains of the
# tracker of speed, tap and its first and last sample, soft stiffness and damping, leaving speed.
STIFF, DAMP, POSITION, CONTACT, ALPHA, BETA, TAP, TAP_FROM, TAP_TO = 0, 1, 2, 3, 4, 5, 6, 7, 8
SOFT, SOFT_DAMP, LEAVE, WALL = 9, 10, 11, 12
# Of limits: currents, speed, torque; lowest and highest commands.
LIMITED, LOW_M, HIGH_M, LOW_B, HIGH_B = 4, 4, 5, 6, 7
# Of the result: which limit tripped first, from 1, and when; largest of all; rms speed at the end
# [rad/s]; whether the wall was left.
TRIPPED, WHEN, MOST, AT_REST, LEFT, RESULT = 0, 1, 2, 6, 7, 8
# Of places: rows of the plant, then rows of its inputs.
OMEGA, THETA, MOTOR_CURRENT, BRAKE_CURRENT = 0, 1, 2, 3
MOTOR_COMMAND, BRAKE_COMMAND, HAND_ANGLE, HAND_SPEED, HAND_TURN = 4, 5, 6, 7, 8
# Of a wall's tracker: angle and speed.
TRACKED, TURNING, TRACKER = 0, 1, 2


def trials(
    reference: Any, share: Any, path: Any, noise: Any, wall: Any, limits: Any, hands: Any,
    count: float, ahead: int, last: int, places: Any, n_steps: int, time: float,
    plant: Any, inputs: Any, s: Any, c: Any, p: Any, tracker: Any, queue: Any, result: Any,
) -> None:  # fmt: skip
    """All samples of up to ``LANES`` trials.

    Of each lane l, the first index: reference, share (m, n); path, (m, n + 1) [rad]; noise (m, n,
    3), of motor and brake current [A] and of the torque sensor [N*m]; wall (m, WALL), all zero
    for none; hands (m, 2), stiffness and damping; s, the law's memory; tracker (m, TRACKER); queue
    (m, ahead + 1, 2); result (m, RESULT). last: samples at the end over which the shaft is to be at
    rest. places: where things are in plant and inputs, which are the kernel's.
    """
    n = reference.shape[1]
    for k in range(n):
        running = False
        for l in range(len(result)):  # noqa: E741  (as in the kernels)
            if result[l, TRIPPED] == 0.0:
                running = True
                sample(
                    k, l, reference, share, path, noise[l, k], wall[l], limits, hands[l], count,
                    ahead, places, time, plant, inputs, s[l], c, p, tracker[l], queue[l], result[l],
                )  # fmt: skip
        if not running:
            return
        next_sample(plant, inputs, time / n_steps, n_steps)
        if k >= n - last:
            for l in range(len(result)):  # noqa: E741
                speed = plant[places[OMEGA] * LANES + l]
                result[l, AT_REST] += speed * speed
    for l in range(len(result)):  # noqa: E741
        result[l, AT_REST] = math.sqrt(result[l, AT_REST] / last)


def sample(
    k: int, l: int, reference: Any, share: Any, path: Any, noise: Any, wall: Any, limits: Any,  # noqa: E741
    hand: Any, count: float, ahead: int, places: Any, time: float, plant: Any, inputs: Any, s: Any,
    c: Any, p: Any, tracker: Any, queue: Any, result: Any,
) -> None:  # fmt: skip
    """What lane l shows at sample k, whether a limit ends it, and its inputs until the next."""
    omega, theta = plant[places[OMEGA] * LANES + l], plant[places[THETA] * LANES + l]
    i_m = plant[places[MOTOR_CURRENT] * LANES + l] + noise[0]
    i_b = plant[places[BRAKE_CURRENT] * LANES + l] + noise[1]
    angle = path[l, k]
    turn = path[l, k + 1] - angle
    sensed = hand[0] * (angle - theta) + hand[1] * (turn / time - omega) + noise[2]
    seen = (abs(i_m), abs(i_b), abs(omega), abs(sensed))
    for j in range(LIMITED):
        result[MOST + j] = max(result[MOST + j], seen[j])
        if not seen[j] <= limits[j]:
            result[TRIPPED] = j + 1.0
            result[WHEN] = k * time
            return
    measured = math.floor(theta / count) * count
    torque, depth = reference[l, k], 0.0
    if wall[ALPHA] > 0.0:
        depth, torque = push_back(k, measured, torque, time, wall, tracker, result)
    for j in range(ahead):
        queue[j, 0] = queue[j + 1, 0]
        queue[j, 1] = queue[j + 1, 1]
    volts = queue[ahead]
    answer(measured, omega, sensed, i_m, torque, 0, s, c, p, volts)
    if depth > 0.0:
        volts[1] = max(volts[1], wall[CONTACT])
    volts[0] = min(max(share[l, k] * volts[0], limits[LOW_M]), limits[HIGH_M])
    volts[1] = min(max(share[l, k] * volts[1], limits[LOW_B]), limits[HIGH_B])
    inputs[places[MOTOR_COMMAND] * LANES + l] = queue[0, 0]
    inputs[places[BRAKE_COMMAND] * LANES + l] = queue[0, 1]
    inputs[places[HAND_ANGLE] * LANES + l] = angle
    inputs[places[HAND_SPEED] * LANES + l] = turn / time
    inputs[places[HAND_TURN] * LANES + l] = turn


def push_back(
    k: int, measured: float, torque: float, time: float, wall: Any, tracker: Any, result: Any
) -> tuple[float, float]:
    """Depth of the shaft in its wall [rad], and the torque with the wall's and the tap's [N*m]."""
    tracker[TRACKED] += time * tracker[TURNING]
    missed = measured - tracker[TRACKED]
    tracker[TRACKED] += wall[ALPHA] * missed
    tracker[TURNING] += wall[BETA] * missed
    speed, depth = tracker[TURNING], measured - wall[POSITION]
    if abs(speed) > wall[LEAVE] and k > wall[TAP_FROM]:
        result[LEFT] = 1.0
    if depth > 0.0:
        ramp = 0.0 if result[LEFT] > 0.0 else min(1.0, k / wall[TAP_FROM])
        K = wall[SOFT] + ramp * (wall[STIFF] - wall[SOFT])
        B = wall[SOFT_DAMP] + ramp * (wall[DAMP] - wall[SOFT_DAMP])
        torque -= K * depth + B * speed
    if k >= wall[TAP_FROM] and k < wall[TAP_TO] and result[LEFT] == 0.0:
        torque += wall[TAP]
    return depth, torque
