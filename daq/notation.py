"""Names, units and numbers as mathematics writes them: for HTML, LaTeX and figures.

``omega_dm`` is an omega with index dm, ``alpha1`` an alpha with index 1; a name that is a word
(``current_motor``) stays one. Whatever comes from users is escaped.
"""

import html as _html
import math
import re
from collections.abc import Callable, Mapping

_GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ",
    "eta": "η", "theta": "θ", "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ",
    "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ", "chi": "χ", "psi": "ψ", "omega": "ω",
}  # fmt: skip
_ROUNDING = 1e-12  # of the numbers that sums are made of
JOINTS = "-_,:/"  # behind which a long name may be broken
_SYMBOL = re.compile(rf"({'|'.join(_GREEK)}|[A-Za-z])(\d*)(?:_([A-Za-z0-9]+))?(\(0\))?")
_ATOM = re.compile(r"([^\W\d]\w*(?:\(0\))?)")
_TEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    "Ω": r"\ensuremath{\Omega}", "μ": r"\ensuremath{\mu}", "µ": r"\ensuremath{\mu}",
    "°": r"\ensuremath{^\circ}", "·": r"\ensuremath{\cdot}", "²": r"\ensuremath{^2}",
    "³": r"\ensuremath{^3}", "ω": r"\ensuremath{\omega}",
})  # fmt: skip
_TEX_OPERATORS = {" - ": " $-$ ", " + ": " $+$ "}
_TEX_UNITS = {"*": r"\,", "ohm": r"\ensuremath{\Omega}"}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
# What stands behind a number in a sentence and has a sign of multiplication or a power in it.
_UNIT_BEHIND = re.compile(r"(?<=\d )[^\W\d]\w*(?:[*/^]-?\(?\w+\)?)+")
# Not before a power, which would raise the prefix too: 1 mm^2 is not 1e-3 m^2.
_PREFIXABLE = re.compile(r"(V|A|ohm|H|F|N|W|J|s|Hz|Pa|T|Wb|m|rad)(?![\w^])")


def html(expression: str) -> str:
    """A name or an expression of names (``A alpha0``, ``J_m + J_b``) as HTML."""
    return _translated(expression, _html_atom, _html_rest)


def equation(text: str) -> str:
    """An equation in names (``L_m di_m/dt = v_m - R_m*i_m``) as HTML."""
    parts = re.split(r"\bd([A-Za-z]\w*)/dt", text)
    parts[1::2] = [f"d{_html_atom(name)}/d<i>t</i>" for name in parts[1::2]]
    # A proper minus sign, and a thin space for the sign of multiplication.
    texts = [re.sub(r"(?<![\w;])-(?=[\s<\w(])", "−", html(part)) for part in parts[::2]]
    parts[::2] = [part.replace("*", "\u2009") for part in texts]
    return "".join(parts)


def tex(expression: str) -> str:
    """A name or an expression of names as LaTeX, to stand in text."""
    return _translated(
        expression,
        lambda name: _math(name) or escape_tex(name),
        lambda text: _tex_pieces(text, r"(\^-?[\d.]+| - | \+ )", _TEX_OPERATORS),
    )


def label(expression: str) -> str:
    """A name or an expression of names as a figure's label, in matplotlib's mathtext."""
    return _translated(expression, lambda name: _math(name) or words(name), _label_rest)


def words(name: str) -> str:
    """A signal's name as words, with dollar signs escaped: they would begin mathematics."""
    return name.replace("_", " ").replace("$", r"\$")


def unit_text(unit: str) -> str:
    """A unit in its symbols: ``N·m·s/(rad·A)``, ``Ω``; empty for a pure number."""
    if unit in ("", "1"):
        return ""
    text = re.sub(r"\bohm\b", "Ω", unit).replace("*", "·")
    return re.sub(r"\^(-?\d+)", lambda power: raised(power[1]), text)


def prose(text: str) -> str:
    """A printed sentence as a page has it: ``→`` for ``->``, units in their symbols.

    >>> prose("B_m 579 -> 400 µN*m*s/rad, J 8.2e-5 kg*m^2.")
    'B_m 579 → 400 µN·m·s/rad, J 8.2e-5 kg·m².'
    """
    units = _UNIT_BEHIND.sub(lambda match: unit_text(match[0]), text)
    return units.replace(" -> ", " → ")


def unit_tex(unit: str) -> str:
    """A unit as LaTeX; empty for a pure number."""
    return "" if unit == "1" else _tex_pieces(unit, r"(\^-?\d+|\*|\bohm\b)", _TEX_UNITS)


def bracketed(unit: str) -> str:
    """``[A]`` behind a label; ``[1]`` of a pure number."""
    text = unit_text(unit).replace("$", r"\$")
    return f"[{text or 1}]"


def number(value: float, digits: int = 4) -> str:
    """A number with so many significant digits, exponents in steps of three."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent < 5:
        places = digits - 1 - exponent
        return f"{round(value, places):.{max(places, 0)}f}"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    if int(power) > exponent:  # 9.96e-5 is 1.00e-4, as 0.0996 is 0.100: its last place stays
        mantissa += "0" if digits > 1 else ".0"
    return f"{mantissa}e{int(power)}"


def rounded_off(value: float, size: float) -> float:
    """A number, or 0 where it is what rounding leaves beside numbers of a size.

    >>> rounded_off(0.14 - 0.07 - 0.07 + 2.8e-17, 0.14), rounded_off(1e-6, 0.14)
    (0.0, 1e-06)
    """
    return 0.0 if abs(value) <= _ROUNDING * abs(size) else value


def digits(value: float, deviation: float | None) -> int:
    """Significant digits that an uncertainty supports; 2 where it is unknown."""
    if deviation is None:
        return 2
    if deviation <= 0.0:
        return 4
    ratio = abs(value) / deviation
    return max(2, min(7, math.floor(math.log10(max(ratio, 1e-3))) + 2))


def shortest(value: float) -> str:
    """A number that somebody chose, in the digits that it has, six at most."""
    mantissa, sign, power = number(value, 6).partition("e")
    whole, point, places = mantissa.partition(".")
    places = places.rstrip("0")
    return f"{whole}{point if places else ''}{places}{sign}{power}"


def engineering(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit that bring one to three digits before the point: 1e6, ``µH`` for 5.4e-4 H.

    The factor is 1 from a tenth to a thousand, and for units that take no prefix (kg, 1/s, m^2).
    """
    size = abs(value)
    if not _PREFIXABLE.match(unit) or not math.isfinite(value) or 0.1 <= size < 1000.0:
        return 1.0, unit
    power = 3 * math.floor(math.log10(size) / 3) if size else 0
    prefix = _PREFIXES.get(power)
    return (1.0, unit) if prefix is None else (10.0**-power, f"{prefix}{unit}")


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """A number with its unit, in the multiple of it that reads best: ``5.06 mA``."""
    scale, multiple = engineering(value, unit)
    return with_unit(number(scale * value, digits), multiple)


def with_unit(text: str, unit: str) -> str:
    """Numbers as written, and their unit behind them if they have any.

    >>> with_unit("3.0 .. 3.2", "mm"), with_unit("3.0", "1")
    ('3.0 .. 3.2 mm', '3.0')
    """
    return text if unit in ("", "1") else f"{text} {unit}"


def measured(value: float, unit: str, half_width: float | None) -> tuple[str, str]:
    """A number in the digits that its 95 % interval supports, and the multiple of its unit.

    half_width: of the interval in parts of the value; None without one.
    """
    scale, multiple = engineering(value, unit)
    deviation = None if half_width is None else abs(value) * half_width / 1.96
    return number(scale * value, digits(value, deviation)), multiple


def percent(value: float) -> str:
    """A fit, to a tenth of a per cent."""
    return f"{value:.1f}" if math.isfinite(value) else "-"


def number_html(text: str) -> str:
    """A printed number (``5.4e-4``) with a proper minus and power of ten, as HTML."""
    mantissa, _, power = text.partition("e")
    shown = _html.escape(mantissa.replace("-", "−"))
    return f"{shown}×10<sup>{str(int(power)).replace('-', '−')}</sup>" if power else shown


def number_tex(text: str) -> str:
    """A printed number (``5.4e-4``) as LaTeX."""
    mantissa, _, power = text.partition("e")
    return rf"${mantissa}\times10^{{{int(power)}}}$" if power else f"${mantissa}$"


def escape_tex(text: str) -> str:
    """Any text, as LaTeX prints it."""
    return text.translate(_TEX)


def raised(digits: str) -> str:
    """A whole number as superscripts."""
    return digits.translate(_RAISED)


def _translated(expression: str, atom: Callable[[str], str], rest: Callable[[str], str]) -> str:
    parts = _ATOM.split(expression)
    return "".join(atom(part) if k % 2 else rest(part) for k, part in enumerate(parts))


def _symbol(name: str) -> tuple[str, str, str] | None:
    """A letter, its index, and ``(0)`` for a value at time 0, or empty; None for a word."""
    match = _SYMBOL.fullmatch(name)
    if match is None:
        return None
    letter, digits, index, start = match.groups(default="")
    return letter, ",".join(part for part in (digits, index) if part), start


def _html_atom(name: str) -> str:
    symbol = _symbol(name)
    if symbol is None:
        return _html.escape(name)
    letter, index, start = symbol
    return f"<i>{_GREEK.get(letter, letter)}</i>{f'<sub>{index}</sub>' if index else ''}{start}"


def _html_rest(text: str) -> str:
    powers = re.sub(r"\^(-?[\d.]+)", r"<sup>\1</sup>", _html.escape(text))
    return powers.replace(" - ", " − ")


def _math(name: str) -> str | None:
    """A symbol as LaTeX and matplotlib set it; None for a word."""
    symbol = _symbol(name)
    if symbol is None:
        return None
    letter, index, start = symbol
    command = f"\\{letter}" if letter in _GREEK else letter
    below = f"_{{\\mathrm{{{index}}}}}" if index else ""
    return f"${command}{below}{start}$"


def _tex_pieces(text: str, pattern: str, signs: Mapping[str, str]) -> str:
    """A text as LaTeX; pattern: its powers and signs, signs: what the latter become."""
    pieces = re.split(pattern, text)
    for k, piece in enumerate(pieces):
        is_power = piece.startswith("^") and len(piece) > 1
        pieces[k] = f"$^{{{piece[1:]}}}$" if is_power else signs.get(piece) or escape_tex(piece)
    return "".join(pieces)


def _label_rest(text: str) -> str:
    powers = re.sub(r"\^(-?[\d.]+)", r"$^{\1}$", text.replace("$", r"\$"))
    return powers.replace(" - ", " − ")
