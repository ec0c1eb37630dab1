"""A model's equations as plain scalar Python, without its tuples, closures and helpers.

``slopes(x, u, p, dx)`` writes dx/dt of all states into dx, ``observe(x, u, p, y)`` the outputs into
y. The text is straight-line code over
flat arrays, in which conditions are choices: what Numba compiles and ``c_text`` makes C99 of.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

from sysid.engine.structure import branching
from sysid.engine.tape import Tape
from sysid.problem.model import ModelError, ProcessModel

_SELECT = re.compile(r"select\((.*?), (.*?), (.*?)\)")
_CHOICE = r"(\2 if \1 else \3)"


class ScalarEquations:
    """A model's dx/dt, followed once, of which functions are written.

    Raises ModelError for equations that cannot be followed.

    >>> from sysid.examples import lag
    >>> text = ScalarEquations(lag()).slopes()
    >>> text.split()[-3:]
    ['dx[0]', '=', 't2']
    """

    def __init__(self, model: ProcessModel) -> None:
        self._tape = Tape()
        try:
            self._rows = branching(self._tape, model, model.derivative)
            if model.output is None:
                self._outputs = [f"x{model.state_names.index(k)}" for k in model.output_names]
            else:
                self._outputs = branching(self._tape, model, model.output)
        except Exception as error:
            raise ModelError(
                f"model {model.name}: its equations cannot be followed ({error}); they may use "
                "arithmetic, math functions, conditions and helper functions of the same kind"
            ) from error

    def slopes(self) -> str:
        """``slopes(x, u, p, dx)``: all of dx/dt."""
        stores = [f"dx[{i}] = {row}" for i, row in enumerate(self._rows)]
        head = "slopes(x: Array, u: Array, p: Array, dx: Array) -> None"
        return self._text(head, "dx/dt of all states.", self._rows, {}, stores)

    def observe(self) -> str:
        """``observe(x, u, p, y)``: all outputs."""
        stores = [f"y[{j}] = {value}" for j, value in enumerate(self._outputs)]
        head = "observe(x: Array, u: Array, p: Array, y: Array) -> None"
        return self._text(head, "All outputs.", self._outputs, {}, stores)

    def row(self, name: str, arguments: Sequence[str], place: int, at: Mapping[str, str]) -> str:
        """A function of one row of dx/dt by its place.

        arguments: of it, before p. at: text for states and inputs by their names on a tape, such
        as ``{"x4": "omega"}``; zero for all others.
        """
        typed = "".join(f"{argument}: float, " for argument in arguments)
        head = f"{name}({typed}p: Array) -> float"
        value = self._rows[place]
        text = f"Row {place} of dx/dt, what is not named being zero."
        zeros = {key: at.get(key, "0.0") for key in self._used([value]) if key[0] in "xu"}
        return self._text(head, text, [value], zeros, [f"return {value}"])

    def _used(self, values: Iterable[str]) -> list[str]:
        """States, inputs and parameters that values need."""
        names = {*values}.union(*(line.operands for line in self._tape.needed(values)))
        letters = (name for name in names if re.fullmatch(r"[xup]\d+", name))
        return sorted(letters, key=lambda name: ("xup".index(name[0]), int(name[1:])))

    def _text(
        self, head: str, about: str, values: Sequence[str], at: Mapping[str, str], last: list[str]
    ) -> str:
        values = list(values)
        lines = [
            f"{name} = {at.get(name, f'{name[0]}[{name[1:]}]')}" for name in self._used(values)
        ]
        lines += [
            f"{line.name} = {_SELECT.sub(_CHOICE, line.text)}" for line in self._tape.needed(values)
        ]
        return "\n    ".join([f"def {head}:", f'"""{about}"""', *lines, *last]) + "\n"
