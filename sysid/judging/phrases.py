"""Numbers in sentences, in the multiple of their unit that reads best, as tables print them."""

import math
import re
from collections.abc import Sequence

_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# Not before a power, which would raise the prefix too: 1 mm^2 is not 1e-3 m^2.
_PREFIXABLE = re.compile(r"(V|A|ohm|H|F|N|W|J|s|Hz|Pa|T|Wb|m|rad)(?![\w^])")


def sized(value: float, unit: str, digits: int = 3) -> str:
    """A number of so many digits at most, with its unit.

    >>> sized(5.01e-5, "s"), sized(1e-4, "s", 2), sized(8.2e-5, "kg*m^2"), sized(2.0, "1")
    ('50.1 µs', '100 µs', '8.2e-5 kg*m^2', '2')
    """
    factor, multiple = _multiple(value, unit)
    return f"{_number(factor * value, digits)} {multiple}".rstrip()


def change(old: float, new: float, unit: str) -> str:
    """Two values, to as many digits as tell them apart.

    >>> change(0.0030012, 0.0030104, "H"), change(4.5e-4, 1.1e-3, "H"), change(1.2, 80.0, "1")
    ('3.001 -> 3.01 mH', '0.45 -> 1.1 mH', '1.2 -> 80')
    """
    size, difference = max(abs(old), abs(new)), abs(new - old)
    apart = math.ceil(math.log10(size / difference)) + 1 if difference else 3
    digits = min(max(apart, 3), 6)
    factor, multiple = _multiple(size, unit)
    before, after = (_number(factor * value, digits) for value in (old, new))
    return f"{before} -> {after} {multiple}".rstrip()


def either(names: Sequence[str]) -> str:
    """Names of which one is meant.

    >>> either(["load", "voltage", "omega"])
    'load, voltage or omega'
    """
    return " or ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _number(value: float, digits: int) -> str:
    # No power for the sake of digits that are not told: 100, not 1e2.
    rounded = f"{float(f'{value:.{digits}g}'):.{max(digits, 4)}g}"
    return re.sub(r"e([+-])0*", lambda power: f"e{power[1].strip('+')}", rounded)


def _multiple(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit that bring one to three digits before the point, as prefixes can."""
    size = abs(value)
    if not _PREFIXABLE.match(unit) or not math.isfinite(value) or 0.1 <= size < 1e3 or not size:
        return 1.0, "" if unit == "1" else unit
    power = 3 * math.floor(math.log10(size) / 3)
    prefix = _PREFIXES.get(power)
    return (1.0, unit) if prefix is None else (10.0**-power, f"{prefix}{unit}")
