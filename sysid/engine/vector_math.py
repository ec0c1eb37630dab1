# mypy: ignore-errors
"""Elementary functions as branch-free arithmetic, so that lanes of them become vector code.

They stand in for the ``math`` module inside compiled models: a call into the C library would
keep the whole lane loop scalar. Relative errors stay below 1e-14 over the ranges named; not a
number in gives not a number out.
"""

# Whatever is not defined below is math's own.
from math import *  # noqa: F403
from typing import Any

from numba import njit, types

from sysid.engine.intrinsics import always_inline, from_bits, to_bits, to_int32

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}

_LOG2_E = 1.4426950408889634
_LN2_HIGH = 0.6931471803691238  # ln 2 in two parts, the first with zeros at its end
_LN2_LOW = 1.9082149292705877e-10
# pi/2 in three parts of 33 bits (and the rest), as Cody and Waite do it
_PIO2_HIGH = 1.5707963267341256
_PIO2_MIDDLE = 6.077100506303966e-11
_PIO2_LOW = 2.0222662487959506e-21


@njit(**_OPTIONS)
def _split(y: float) -> tuple[float, float]:
    """2^k and e^r - 1 of the two factors of e^y = 2^k e^r, |r| <= ln 2 / 2."""
    k = floor(y * _LOG2_E + 0.5)  # noqa: F405
    r = (y - k * _LN2_HIGH) - k * _LN2_LOW
    # Taylor series of degree 13 leaves 4e-18.
    s = 1.0 + r * (1.0 / 13.0)
    s = 1.0 + r * (1.0 / 12.0) * s
    s = 1.0 + r * (1.0 / 11.0) * s
    s = 1.0 + r * (1.0 / 10.0) * s
    s = 1.0 + r * (1.0 / 9.0) * s
    s = 1.0 + r * (1.0 / 8.0) * s
    s = 1.0 + r * (1.0 / 7.0) * s
    s = 1.0 + r * (1.0 / 6.0) * s
    s = 1.0 + r * (1.0 / 5.0) * s
    s = 1.0 + r * (1.0 / 4.0) * s
    s = 1.0 + r * (1.0 / 3.0) * s
    s = 1.0 + r * 0.5 * s
    return from_bits((types.int64(to_int32(k)) + 1023) << 52), r * s


@njit(**_OPTIONS)
def exp(x: float) -> float:
    """e^x; above 709 infinite, below -708 within 1e-307 of zero."""
    y = min(max(x, -708.0), 709.0)
    power, rest = _split(y)
    over = inf if x > 709.0 else 0.0 if x == x else nan  # noqa: F405, PLR0124
    return power + power * rest + over


@njit(**_OPTIONS)
def tanh(x: float) -> float:
    """Hyperbolic tangent."""
    a = min(abs(x), 20.0)
    power, rest = _split(-2.0 * a)
    less = power * rest + (power - 1.0)  # e^(-2a) - 1 without cancellation
    size = -less / (less + 2.0)
    return (size if x >= 0.0 else -size) + (0.0 if x == x else nan)  # noqa: F405, PLR0124


@njit(**_OPTIONS)
def log(x: float) -> float:
    """Natural logarithm; of zero minus infinity, of a negative number not a number."""
    always_inline()
    tiny = x < 1e-290
    bits = to_bits(x * 1.8446744073709552e19 if tiny else x)  # 2^64
    k = float(types.int32((bits >> 52) & 0x7FF)) - (1087.0 if tiny else 1023.0)
    m = from_bits((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000)
    above = m > 1.4142135623730951
    m = 0.5 * m if above else m
    k = k + 1.0 if above else k
    # log m = 2 artanh s with |s| < 0.172, to the power 21.
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    t = q * (1.0 / 19.0 + q * (1.0 / 21.0))
    t = q * (1.0 / 15.0 + q * (1.0 / 17.0) + q * t)
    t = q * (1.0 / 11.0 + q * (1.0 / 13.0) + q * t)
    t = q * (1.0 / 7.0 + q * (1.0 / 9.0) + q * t)
    t = q * (1.0 / 3.0 + q * (1.0 / 5.0) + q * t)
    value = k * _LN2_HIGH + (2.0 * s + (2.0 * s * t + k * _LN2_LOW))
    value = inf if x == inf else value  # noqa: F405
    value = -inf if x == 0.0 else value  # noqa: F405
    return value if x >= 0.0 else nan  # noqa: F405


@njit(**_OPTIONS)
def pow(x: float, y: float) -> float:
    """x^y; relative errors grow with |y log x|, to 1e-14 where that is 50.

    Of a negative x only whole powers are numbers.
    """
    always_inline()
    size = exp(y * log(abs(x)))
    size = 0.0 if x == 0.0 and y > 0.0 else size
    odd = y - 2.0 * floor(0.5 * y) == 1.0  # noqa: F405
    size = -size if x < 0.0 and odd else size
    size = nan if x < 0.0 and floor(y) != y else size  # noqa: F405
    return 1.0 if y == 0.0 else size


@njit(**_OPTIONS)
def _sine_and_cosine(x: float, quarter: int) -> float:
    """sin(x + quarter * pi/2), to full accuracy for |x| up to 1e5."""
    k = floor(x * 0.6366197723675814 + 0.5)  # noqa: F405
    r = ((x - k * _PIO2_HIGH) - k * _PIO2_MIDDLE) - k * _PIO2_LOW
    q = r * r
    s = 1.0 - q / 210.0 * (1.0 - q / 272.0)
    s = 1.0 - q / 156.0 * s
    s = 1.0 - q / 110.0 * s
    s = 1.0 - q / 72.0 * s
    s = 1.0 - q / 42.0 * s
    s = 1.0 - q / 20.0 * s
    sine = r * (1.0 - q / 6.0 * s)
    c = 1.0 - q / 182.0 * (1.0 - q / 240.0)
    c = 1.0 - q / 132.0 * c
    c = 1.0 - q / 90.0 * c
    c = 1.0 - q / 56.0 * c
    c = 1.0 - q / 30.0 * c
    c = 1.0 - q / 12.0 * c
    cosine = 1.0 - 0.5 * q * c
    # Quadrant modulo 4 in floats: vector units have no such integers.
    turn = k + quarter
    turn -= 4.0 * floor(0.25 * turn)  # noqa: F405
    odd = turn == 1.0 or turn == 3.0  # noqa: PLR1714  (a set does not compile to vectors)
    value = cosine if odd else sine
    return -value if turn >= 2.0 else value


@njit(**_OPTIONS)
def sin(x: float) -> float:
    """Sine."""
    return _sine_and_cosine(x, 0)


@njit(**_OPTIONS)
def cos(x: float) -> float:
    """Cosine."""
    return _sine_and_cosine(x, 1)


# What slopes are written with (``gradient``), beside the functions of math.
OF_SLOPES = ("sign", "select", "power_slope", "exponent_slope")


@njit(**_OPTIONS)
def sign(x: float) -> float:
    """The derivative of |x|; at zero, where it jumps, the mean of both sides."""
    always_inline()
    return 1.0 if x > 0.0 else -1.0 if x < 0.0 else 0.0 * x


@njit(**_OPTIONS)
def select(condition: bool, first: float, second: float) -> float:
    """``first`` where a condition holds, else ``second``."""
    always_inline()
    return first if condition else second


@njit(**_OPTIONS)
def power_slope(x: float, y: float, dx: float) -> float:
    """y x^(y-1) dx; 0 where y or dx is, even if x^(y-1) is infinite."""
    always_inline()
    slope = y * pow(x, y - 1.0) * dx
    return 0.0 if y * dx == 0.0 else slope


@njit(**_OPTIONS)
def exponent_slope(x: float, power: float, dy: float) -> float:
    """x^y ln(x) dy, by ``power`` = x^y; 0 at x = 0, as 0^y is for all y > 0."""
    always_inline()
    slope = power * log(x) * dy
    return 0.0 if x == 0.0 or dy == 0.0 else slope
