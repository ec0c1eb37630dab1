"""The actuator's model over a sample, in the manner of ``haptics.laws``: fixed memory and steps.

With A the part of dx/dt that is stiff, the amplifiers and coils, ETDRK4 (Cox & Matthews 2002) as
in ``sysid.engine.scheme``, by the change D of the slopes beyond A's:

    a = x + Q k    b = a + Q D_a    c = x + F k + 2 Q D_b    next = x + F k + G (D_a + D_b) + H D_c

m: A, Q, F, G, H of one step, row by row. hand: stiffness [N*m/rad], damping [N*m*s/rad], angle
[rad], speed [rad/s] of a hand at the shaft; place: of omega, theta among the states and of the
hand's torque among the inputs. k, d_a, d_b, d_c, y, dy: (n,) each, to work in.
"""

from collections.abc import MutableSequence
from typing import TYPE_CHECKING

Array = MutableSequence[float]

if TYPE_CHECKING:

    def slopes(x: Array, u: Array, p: Array, dx: Array) -> None:
        """dx/dt of all states."""


def advance(
    x: Array, u: Array, p: Array, m: Array, hand: Array, n: int, steps: int, time: float,
    omega: int, theta: int, load: int,
    k: Array, d_a: Array, d_b: Array, d_c: Array, y: Array, dy: Array,
) -> None:  # fmt: skip
    """The states x, (n,), ``time`` later in equal steps; u held but for what the hand adds."""
    torque, h = u[load], time / steps
    for _ in range(steps):
        u[load] = torque + hand_torque(x[omega], x[theta], hand)
        slopes(x, u, p, k)
        hand[2] += 0.5 * h * hand[3]
        for i in range(n):
            total = x[i]
            for j in range(n):
                total += m[n * (n + i) + j] * k[j]
            y[i] = total
        move(x, y, u, p, m, hand, n, torque, omega, theta, load, k, dy, d_a)
        for i in range(n):
            total = x[i]
            for j in range(n):
                total += m[n * (n + i) + j] * (k[j] + d_a[j])
            y[i] = total
        move(x, y, u, p, m, hand, n, torque, omega, theta, load, k, dy, d_b)
        hand[2] += 0.5 * h * hand[3]
        for i in range(n):
            total = x[i]
            for j in range(n):
                total += m[n * (2 * n + i) + j] * k[j] + 2.0 * m[n * (n + i) + j] * d_b[j]
            y[i] = total
        move(x, y, u, p, m, hand, n, torque, omega, theta, load, k, dy, d_c)
        for i in range(n):
            total = x[i]
            for j in range(n):
                total += m[n * (2 * n + i) + j] * k[j] + m[n * (4 * n + i) + j] * d_c[j]
                total += m[n * (3 * n + i) + j] * (d_a[j] + d_b[j])
            y[i] = total
        for i in range(n):
            x[i] = y[i]
    u[load] = torque


def hand_torque(omega: float, theta: float, hand: Array) -> float:
    """Of a spring and a damper to the hand [N*m]."""
    return -hand[0] * (theta - hand[2]) - hand[1] * (omega - hand[3])


def move(
    x: Array, y: Array, u: Array, p: Array, m: Array, hand: Array, n: int, torque: float,
    omega: int, theta: int, load: int, k: Array, dy: Array, change: Array,
) -> None:  # fmt: skip
    """By how much the slopes at y differ from k at x, beyond A (y - x)."""
    u[load] = torque + hand_torque(y[omega], y[theta], hand)
    slopes(y, u, p, dy)
    for i in range(n):
        total = dy[i] - k[i]
        for j in range(n):
            total -= m[n * i + j] * (y[j] - x[j])
        change[i] = total
