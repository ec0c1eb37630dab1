"""Quadrature encoder with the speed estimate of a counter that times its edges."""

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from daq.hal import FloatArray

_STANDSTILL = 0.1  # s without an edge after which the shaft counts as standing still


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
        in between are timed by interpolation. With a common origin the result does not depend on
        where a motion is cut into calls.
        """
        per_radian = self.counts_per_turn / (2.0 * math.pi)
        counted = np.vstack([motion, last]) * per_radian
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
        here, there = there, motion[i + 1, 0]
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
        share = (boundary - here) / (there - here) if there != here else 1.0
        crossing = now + min(max(share, 0.0), 1.0) * step
        if abs(moved) > 1.0:
            # Both edges lie in this step: the speed half a count before the last of them.
            middle = share - 0.5 / abs(there - here)
            rate = (there - here) / step + (middle - 0.5) * (motion[i + 1, 1] - motion[i, 1])
        elif direction == sign and crossing > edge_time:
            rate = sign / (crossing - edge_time)
        else:
            rate = 0.0
        count, edge_time, direction = math.floor(there), crossing, sign
    memory[0], memory[1], memory[2], memory[3] = count, edge_time, direction, rate
    return counts, rates
