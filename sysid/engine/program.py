"""Source text of functions that were written down on a tape.

A program is functions of tuples: ``constants(p)``, ``remainder(x, u, c)`` for N, ``observe(x, u,
c)`` where the model has an output function and ``margins(x, u, c)``, how far each guarded number
is above each of its limits; c is what ``constants`` returned, all that the parameters fix. They
need math and always_inline.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from sysid.engine.tape import Line, Tape

K = TypeVar("K")

_LONGEST = 25  # items of a tuple display
# Which of the model's functions one of the program calls, where that could not be followed.
_CALLED = {"remainder": "derivative", "observe": "output"}


@dataclass
class Writer:
    """Writes functions on a tape as Python text.

    functions: values by name, none for a function that calls the model's. coefficients: further
    numbers that the parameters fix and that are needed. calls: functions of the model that the
    text calls.
    """

    tape: Tape
    n_parameters: int
    functions: Mapping[str, Sequence[str]]
    coefficients: Iterable[str]

    def __post_init__(self) -> None:
        functions, tape = self.functions, self.tape
        self._parameters = [f"p{i}" for i in range(self.n_parameters)]
        self.calls = frozenset(_CALLED[name] for name, values in functions.items() if not values)
        used = set(self.coefficients)
        for values in functions.values():
            used |= _used(self._varying(values), values) if values else {*self._parameters}
        constants = [name for name in used if tape.named(name) and tape.fixed(name)]
        self.constants = sorted(constants, key=lambda name: (name[0], int(name[1:])))
        self._places = {name: f"c[{k}]" for k, name in enumerate(self.constants)}

    def placed(self, names: Mapping[K, str]) -> dict[K, str]:
        """Text by which other code finds numbers that the parameters fix, for their names."""
        return {key: self._places.get(name, name) for key, name in names.items()}

    def program(self) -> str:
        """Text of all functions."""
        texts = [self._text("constants(p)", self.tape.needed(self.constants), self.constants, {})]
        for name, values in self.functions.items():
            head = f"{name}(x, u, c)"
            if values:
                texts.append(self._text(head, self._varying(values), values, self._places))
            else:
                p = listed(self._places[name] for name in self._parameters)
                call = f"    return {_CALLED[name]}(x, u, {p})"
                texts.append(f"def {head}:\n    always_inline()\n{call}")
        return "\n\n".join([*texts, ""])

    def _varying(self, values: Sequence[str]) -> list[Line]:
        return [line for line in self.tape.needed(values) if not line.fixed]

    def _text(
        self, head: str, lines: list[Line], values: Sequence[str], places: Mapping[str, str]
    ) -> str:
        text = [f"def {head}:", "    always_inline()"]
        for name in sorted(_used(lines, values) - {line.name for line in lines}):
            if self.tape.named(name):
                text.append(f"    {name} = {places.get(name) or f'{name[0]}[{name[1:]}]'}")
        text += [f"    {line.name} = {line.text}" for line in lines]
        return "\n".join([*text, f"    return {listed(values)}"])


def _used(lines: Iterable[Line], values: Iterable[str]) -> set[str]:
    return set(values).union(*(line.operands for line in lines))


def block(head: str, *parts: Iterable[str]) -> list[str]:
    """Lines that begin a block, and those within it."""
    lines = [line for part in parts for line in part] or ["pass"]
    return [head, *(f"    {line}" for line in lines)]


def listed(items: Iterable[str]) -> str:
    """Text of a tuple."""
    texts = list(items)
    # Python builds longer displays by way of a list, which Numba does not always follow.
    parts = [texts[i : i + _LONGEST] for i in range(0, len(texts), _LONGEST)] or [[]]
    return " + ".join(f"({', '.join(part)}{',' * (len(part) == 1)})" for part in parts)
