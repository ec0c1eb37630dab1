"""A law with an actuator's equations, as one text: for Python, for Numba, for C99."""

import functools
import inspect
import types
from collections.abc import Callable
from typing import Any

from daq.experiment import Sample
from daq.torque import LawProgram
from haptics import laws
from haptics.dynamics import SHAFT
from sysid import ProcessModel
from sysid.arrays import FloatArray
from sysid.engine.compiler import compiled_text
from sysid.engine.scalar_text import ScalarEquations

LAWS = ("static", "feedforward", "lqg")


@functools.lru_cache(maxsize=8)
def law_text(model: ProcessModel) -> str:
    """All laws, and the functions of the model that they call; ``slopes`` of it as well.

    Raises ModelError for equations that cannot be followed.
    """
    equations = ScalarEquations(model)
    names = model.state_names
    omega, z, theta = (f"x{names.index(name)}" for name in SHAFT)
    currents = {f"x{names.index(f'current_{name}')}": f"i_{name[0]}" for name in ("motor", "brake")}
    shaft = {omega: "omega", z: "z", theta: "theta", **currents}
    places = names.index("omega"), names.index("z")
    arguments = ("i_m", "i_b", "omega", "z", "theta")
    functions = [
        equations.row("acceleration", arguments, places[0], shaft),
        equations.row("z_rate", ("omega", "z"), places[1], {omega: "omega", z: "z"}),
        equations.slopes(),
    ]
    return "\n\n".join([source_of(laws), *functions])


def source_of(module: types.ModuleType) -> str:
    """Text of a module's numbers and functions, without what it imports."""
    numbers = [f"{k} = {v!r}" for k, v in vars(module).items() if k.isupper()]
    functions = [
        inspect.getsource(item)
        for item in vars(module).values()
        if isinstance(item, types.FunctionType) and item.__module__ == module.__name__
    ]
    head = "from __future__ import annotations"
    return "\n\n".join([head, "\n".join(numbers), *functions])


@functools.lru_cache(maxsize=8)
def law_functions(model: ProcessModel) -> types.SimpleNamespace:
    """The same as functions of Python."""
    import math

    scope: dict[str, Any] = {"math": math}
    exec(compile(law_text(model), "<laws>", "exec"), scope)
    return types.SimpleNamespace(**scope)


@functools.lru_cache(maxsize=4)
def compiled_laws(model: ProcessModel) -> dict[str, Callable[..., None]]:
    """The same as machine code, by name."""
    return dict(zip(LAWS, compiled_text("laws", law_text(model), LAWS), strict=True))


def law_program(
    law: str, model: ProcessModel, parameters: FloatArray, constants: list[float]
) -> LawProgram:
    """A law with its constants."""
    return LawProgram(
        law, law_text(model), laws.STATES, tuple(constants), tuple(parameters.tolist())
    )


class ProgramLaw:
    """A program at work, from rest, run by Python.

    state, constants, parameters: as of ``haptics.laws``.
    """

    def __init__(self, program: LawProgram, model: ProcessModel) -> None:
        self._step = getattr(law_functions(model), program.entry)
        self.state = [0.0] * program.n_states
        self.constants, self.parameters = list(program.constants), list(program.parameters)
        self._tick, self._volts = -1, [0.0, 0.0]

    def volts(self, sample: Sample, torque: float) -> tuple[float, float]:
        """Commands of motor and brake [V]."""
        lost = sample.tick - self._tick - 1 if self._tick >= 0 else 0
        self._tick, volts = sample.tick, self._volts
        self._step(
            sample.theta, sample.omega, sample.torque, sample.current_motor, torque, lost,
            self.state, self.constants, self.parameters, volts,
        )  # fmt: skip
        return volts[0], volts[1]
