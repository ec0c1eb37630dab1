"""Ranges of drivers and windings from the currents' responses.

In steady state, and over the whole of a step, the gain a [A/V], the current per speed b [A*s/rad]
and the mean delay d [s] of a current's response are, with f = 1 + K/R for a closed-loop driver
(3.10) and f = 1 for an open-loop one (3.7),

    a = K_v2i K/R / f  (closed)    a = G/R  (open)
    b = n_c K_m / (R f)            d = (L + R/omega_d) / (R f)

so that resistance, driver gain and motor constant follow up to a common factor, and of
inductance and driver cutoff how large and how small they may be. What is assumed of one narrows
the others.
"""

import math

from sim_rig.guesses.current_response import CurrentResponse
from sim_rig.guesses.ranges import Interval, Ranges
from sim_rig.physics.options import DriverKind

_ROUNDS = 3  # after which ranges that narrow each other have settled


def narrow(ranges: Ranges, channel: str, driver: DriverKind, response: CurrentResponse) -> None:
    """Narrow what the response of a channel, motor or brake, ties together."""
    index, where = channel[0], f"in {response.source}"
    resistance = f"R_{index}"
    gain = response.gain
    source = f"current_{channel} over its command, {_text(gain)} A/V {where}"
    ratio, factor = gain, (1.0, 1.0)
    if driver == "closed":
        # a = K_v2i r / (1 + r) with r = K/R; a noisy a may reach the K_v2i of an ideal amplifier
        lowest_v2i, highest_v2i = ranges.intervals["K_v2i"]
        ratio = _loop_gain(gain[0], highest_v2i), _loop_gain(gain[1], lowest_v2i)
        factor = 1.0 + ratio[0], 1.0 + ratio[1]
        source += f", K_v2i {lowest_v2i:g}"
    for _ in range(_ROUNDS):
        driver_gain = f"{'K' if driver == 'closed' else 'G'}_d{index}"
        ranges.narrow_product(driver_gain, ratio, resistance, source)
        if response.per_speed is not None:
            low, high = response.per_speed
            size = sorted(abs(n) for n in ranges.intervals["n_c"])
            scale = low * factor[0] / size[1], high * factor[1] / size[0]
            felt = f"current_motor per speed, {_text(response.per_speed)} A*s/rad {where}"
            ranges.narrow_product("K_m", scale, resistance, felt)
    delay = response.delay[1]
    longest = delay * factor[1]
    source = f"mean delay of current_{channel}, {1e3 * delay:.3g} ms at most {where}"
    highest = longest * ranges.intervals[resistance][1]
    ranges.narrow(f"L_{index}", 0.0, highest, f"{source}, {ranges.text(resistance)}")
    if longest > 0.0:
        ranges.narrow(f"omega_d{index}", 1.0 / longest, math.inf, source)


def _loop_gain(gain: float, K_v2i: float) -> float:
    """r of a = K_v2i r / (1 + r)."""
    return gain / (K_v2i - gain) if K_v2i > gain else math.inf


def _text(interval: Interval) -> str:
    return f"{interval[0]:.4g} .. {interval[1]:.4g}"
