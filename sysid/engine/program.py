"""Source text of functions that were written down on a tape."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from sysid.engine.tape import Line, Tape

K = TypeVar("K")

_LONGEST = 25  # items of a tuple display


@dataclass(frozen=True)
class Program:
    """Python text of equations, in which what parameters fix is worked out once.

    text: functions of tuples, ``constants(p)``, ``remainder(x, u, c)`` for N, ``observe(x, u,
    c)`` where the model has an output function and ``margins(x, u, c)``, how far each guarded
    number is above each of its limits; c is what ``constants`` returned. They need math and
    always_inline.
    n_constants: its length. calls: which of ``derivative`` and ``output`` the text refers to.
    """

    text: str
    n_constants: int
    calls: frozenset[str]


# Which of the model's functions a function of the program stands for, and its values where that
# could be followed.
Followed = tuple[str, Sequence[str] | None]


class Writer:
    """Writes functions on a tape as Python text; what parameters fix goes into ``constants``."""

    def __init__(
        self,
        tape: Tape,
        n_parameters: int,
        functions: Mapping[str, Followed],
        coefficients: Iterable[str],
    ) -> None:
        self._tape = tape
        self._functions = functions
        self._parameters = [f"p{i}" for i in range(n_parameters)]
        used = set(coefficients)
        for _, values in functions.values():
            used |= self._used(self._varying(values), values) if values else {*self._parameters}
        constants = [name for name in used if tape.named(name) and tape.fixed(name)]
        self._constants = sorted(constants, key=lambda name: (name[0], int(name[1:])))
        self._places = {name: f"c[{k}]" for k, name in enumerate(self._constants)}

    def placed(self, names: Mapping[K, str]) -> dict[K, str]:
        """Text by which other code finds numbers that the parameters fix, for their names."""
        return {key: self._places.get(name, name) for key, name in names.items()}

    def program(self) -> Program:
        """All functions."""
        texts = [
            self._text("constants(p)", self._tape.needed(self._constants), self._constants, {})
        ]
        for name, (model_function, values) in self._functions.items():
            if values:
                lines = self._varying(values)
                texts.append(self._text(f"{name}(x, u, c)", lines, values, self._places))
            else:
                p = listed(self._places[name] for name in self._parameters)
                body = f"    always_inline()\n    return {model_function}(x, u, {p})"
                texts.append(f"def {name}(x, u, c):\n{body}")
        calls = frozenset(called for called, values in self._functions.values() if not values)
        return Program("\n\n".join([*texts, ""]), len(self._constants), calls)

    def _varying(self, values: Sequence[str]) -> list[Line]:
        return [line for line in self._tape.needed(values) if not line.fixed]

    @staticmethod
    def _used(lines: Iterable[Line], values: Iterable[str]) -> set[str]:
        return set(values).union(*(line.operands for line in lines))

    def _text(
        self, head: str, lines: list[Line], values: Sequence[str], places: Mapping[str, str]
    ) -> str:
        text = [f"def {head}:", "    always_inline()"]
        results = {line.name for line in lines}
        for name in sorted(self._used(lines, values) - results):
            if self._tape.named(name):
                text.append(f"    {name} = {places.get(name) or f'{name[0]}[{name[1:]}]'}")
        text += [f"    {line.name} = {line.text}" for line in lines]
        return "\n".join([*text, f"    return {listed(values)}"])


def block(head: str, *parts: Iterable[str]) -> list[str]:
    """Lines that begin a block, and those within it."""
    return [head, *(f"    {line}" for part in parts for line in part)]


def listed(items: Iterable[str]) -> str:
    """Text of a tuple."""
    texts = list(items)
    # Python builds longer displays by way of a list, which Numba does not always follow.
    parts = [texts[i : i + _LONGEST] for i in range(0, len(texts), _LONGEST)] or [[]]
    return " + ".join(f"({', '.join(part)}{',' * (len(part) == 1)})" for part in parts)
