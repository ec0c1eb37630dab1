"""Quadrature encoder with the speed estimate of a counter that times its edges."""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from daq.hal import FloatArray

_STANDSTILL = 0.1  # s without an edge after which the shaft counts as standing still
_HALVINGS = 30  # of a step, in which an edge is sought


@dataclass
class EncoderCounter:
    """Counts of a quadrature encoder and the period-based estimate of their rate.

    counts_per_turn: four times the encoder's cycles. The rate is one count over the time
    between the last two edges in the same direction, never more than the time since the last
    edge allows, and zero after a reversal or 0.1 s of silence. phase: where between two counts an
    angle of zero stands, 0 to 1.
    """

    counts_per_turn: int
    phase: float = 0.0
    # Last count (none yet), time of the last edge, its direction, estimated rate.
    memory: FloatArray = field(default_factory=lambda: np.array([np.nan, -1.0, 0.0, 0.0]))

    def latch(
        self,
        motion: FloatArray,
        last: FloatArray,
        origin: float,
        first: int,
        step: float,
        per_tick: int,
    ) -> tuple[FloatArray, FloatArray]:
        """Counts and their rate [1/s] at every ``per_tick``-th row of the motion.

        motion: (n, 2), angle [rad] and speed [rad/s] at times origin + (first + i) * step, the
        first at a tick; last: (2,), those one step behind them, which end the last interval. Edges
        in between are timed by the cubic through angles and speeds. With a common origin the result
        does not depend on where a motion is cut into calls.
        """
        per_radian = self.counts_per_turn / (2.0 * math.pi)
        counted = np.empty((len(motion) + 1, 2))
        counted[:-1], counted[-1] = motion, last
        counted *= per_radian
        counted[:, 0] += self.phase
        counts, rates = _count(counted, origin, first, step, per_tick, self.memory)
        return counts, rates


@njit(cache=True, nogil=True)
def _count(
    motion: FloatArray, origin: float, first: int, step: float, per_tick: int, memory: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Counts and rates at the ticks; motion: (n + 1, 2), in counts and counts per second."""
    n, there = len(motion) - 1, motion[0, 0]
    counts, rates = np.empty(-(-n // per_tick)), np.empty(-(-n // per_tick))
    if math.isnan(memory[0]):
        memory[0] = math.floor(there)
    count, edge_time, direction, rate = memory[0], memory[1], memory[2], memory[3]
    for i in range(n):
        now = origin + (first + i) * step
        there = motion[i + 1, 0]
        if i % per_tick == 0:
            shown = rate
            if edge_time < 0.0 or now - edge_time > _STANDSTILL:
                shown = 0.0
            elif abs(rate) * (now - edge_time) > 1.0:
                shown = math.copysign(1.0 / (now - edge_time), rate)
            counts[i // per_tick] = count
            rates[i // per_tick] = shown
        moved = math.floor(there) - count
        if moved == 0.0:
            continue
        sign = 1.0 if moved > 0.0 else -1.0
        # The last boundary crossed: the floor going up, one above it going down.
        boundary = math.floor(there) if sign > 0.0 else math.floor(there) + 1.0
        at, ahead = motion[i], motion[i + 1]
        crossing = now + _share(at, ahead, step, boundary) * step
        if abs(moved) > 1.0:
            # Both edges lie in this step.
            edge_time, direction = now + _share(at, ahead, step, boundary - sign) * step, sign
        timed = direction == sign and crossing > edge_time
        rate = sign / (crossing - edge_time) if timed else 0.0
        count, edge_time, direction = math.floor(there), crossing, sign
    memory[0], memory[1], memory[2], memory[3] = count, edge_time, direction, rate
    return counts, rates


@njit(cache=True, nogil=True)
def _share(here: FloatArray, there: FloatArray, step: float, boundary: float) -> float:
    """Part of a step in which a boundary is reached: of the cubic through both ends' motion."""
    way, first, last = there[0] - here[0], step * here[1], step * there[1]
    square, cube = 3.0 * way - 2.0 * first - last, first + last - 2.0 * way
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        passed = here[0] + share * (first + share * (square + share * cube)) - boundary
        if passed * way > 0.0:
            high = share
        else:
            low = share
    return 0.5 * (low + high)
