"""Functions that equations of plants share: limits, dry friction, roots of flows, temperatures.

They are made of what a model's function may hold, and so may be called in one.
"""

import math

CELSIUS = 273.15  # K, of 0 degrees


def limited(x: float, low: float, high: float) -> float:
    """A value kept between two ends: an amplifier's, a valve's.

    >>> limited(7.0, -5.0, 5.0)
    5.0
    """
    return max(low, min(high, x))


def dry_friction(velocity: float, width: float) -> float:
    """Dry friction by its largest value: -1 to 1, in proportion where slower than ``width``.

    width: in the velocity's unit, a thousandth of the velocities that matter.

    >>> dry_friction(0.2, 1e-3), dry_friction(-5e-4, 1e-3)
    (1.0, -0.5)
    """
    return limited(velocity / width, -1.0, 1.0)


def signed_root(x: float, width: float) -> float:
    """The root of a pressure or a level difference, with its sign; straight within ``width``.

    A root's slope has no end at zero, which no solver likes and no flow has.

    >>> signed_root(-4.0, 1e-3), signed_root(0.0, 1e-3)
    (-2.0, 0.0)
    """
    return x / math.sqrt(max(abs(x), width))


def orifice(upstream: float, downstream: float) -> float:
    """Air through an orifice by its area and the gas's constants, between absolute pressures.

    In the pressures' unit: ``sqrt(p_2 (p_1 - p_2))``, and half the pressure upstream where that is
    more than twice the one downstream: it flows at the speed of sound then. Negative backwards.

    >>> orifice(6.0, 1.0), orifice(4.0, 3.2) == -orifice(3.2, 4.0)
    (3.0, True)
    """
    high, low = max(upstream, downstream), min(upstream, downstream)
    low = max(low, 0.5 * high)
    flow = low * signed_root((high - low) / low, 1e-6)
    return flow if upstream > downstream else -flow


def radiation(temperature: float, ambient: float) -> float:
    """The difference of the fourth powers of two temperatures in degrees Celsius [K^4].

    >>> radiation(20.0, 20.0)
    0.0
    """
    hot, cold = temperature + CELSIUS, ambient + CELSIUS
    return (hot * hot + cold * cold) * (hot + cold) * (hot - cold)
