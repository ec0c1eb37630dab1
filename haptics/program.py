"""A law with an actuator's equations, as one text: for Python, for Numba, for C99."""

import functools
import inspect
import math
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm

from daq.experiment import Sample
from daq.torque import LawProgram, ModelStep
from haptics import laws, model_step, trial
from haptics.dynamics import SHAFT
from sysid import Input, Output, Parameter, ProcessModel, linearize
from sysid.arrays import FloatArray
from sysid.engine.compiler import SampleLanes, compiled_text, sample_lanes
from sysid.engine.scalar_text import ScalarEquations

LONGEST_STEP = 4e-4  # s, of the model
HAND = (0.16, 0.0179)  # N*m/rad, N*m*s/rad, by (A.2)
_HAND = (
    Parameter("hand_stiffness", "N*m/rad", HAND[0], 0.0, 100.0),
    Parameter("hand_damping", "N*m*s/rad", HAND[1], 0.0, 10.0),
)
_LIMITED = "limits=true"
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
    head = "from __future__ import annotations"
    return "\n\n".join([head, source_of(laws), source_of(model_step), *functions])


def source_of(module: types.ModuleType) -> str:
    """Text of a module's numbers and functions, without what it imports."""
    numbers = [f"{k} = {v!r}" for k, v in vars(module).items() if k.isupper()]
    functions = [
        inspect.getsource(item)
        for item in vars(module).values()
        if isinstance(item, types.FunctionType) and item.__module__ == module.__name__
    ]
    return "\n\n".join(["\n".join(numbers), *functions])


@functools.lru_cache(maxsize=8)
def law_functions(model: ProcessModel) -> types.SimpleNamespace:
    """The same as functions of Python."""
    scope: dict[str, Any] = {"math": math}
    exec(compile(law_text(model), "<laws>", "exec"), scope)
    return types.SimpleNamespace(**scope)


@functools.lru_cache(maxsize=4)
def compiled_laws(model: ProcessModel) -> dict[str, Callable[..., None]]:
    """The same as machine code, by name."""
    return dict(zip(LAWS, compiled_text("laws", law_text(model), LAWS), strict=True))


def with_limits(model: ProcessModel) -> ProcessModel:
    """The model with the ends of its amplifiers, where it has such a variant; else itself."""
    variant = model.variants().get(_LIMITED) if model.variants is not None else None
    fits = variant is not None and variant.parameter_names == model.parameter_names
    return variant if variant is not None and fits else model


@dataclass(frozen=True)
class TrialKernels:
    """Compiled trials of a law, and the kernel of the plants that they advance.

    model: of the plants, each in a hand of its own.
    """

    model: ProcessModel
    plants: SampleLanes
    run: Callable[..., None]


@functools.lru_cache(maxsize=4)
def trial_kernels(model: ProcessModel, law: str) -> TrialKernels:
    """``haptics.trial`` with a law, as machine code; the actuator's amplifiers have ends."""
    in_hand = held(with_limits(model))
    plants = sample_lanes(in_hand)
    text = source_of(trial).replace("answer(", f"{law}(")
    whole = f"# {plants.key}\n{law_text(model)}\n\n{text}"
    called = {"next_sample": plants.advance}
    (run,) = compiled_text(f"trial_{law}", whole, ["trials"], called)
    return TrialKernels(in_hand, plants, run)


def held(model: ProcessModel) -> ProcessModel:
    """The model in a hand: two more inputs, its angle and speed, and parameters, see ``HAND``."""
    derivative, m, n = model.derivative, len(model.inputs), len(model.parameters)
    omega, _, theta = (model.state_names.index(name) for name in SHAFT)
    load = model.input_names.index("torque")

    def in_hand(x: Any, u: Any, p: Any) -> Any:
        push = p[n] * (u[m] - x[theta]) + p[n + 1] * (u[m + 1] - x[omega])
        return derivative(x, (*u[:load], u[load] + push, *u[load + 1 : m]), p[:n])

    held_inputs = tuple(replace(signal, hold="zoh") for signal in model.inputs)
    return ProcessModel(
        f"{model.name} in a hand",
        model.states,
        (*held_inputs, Input("hand_theta", "rad", "foh"), Input("hand_omega", "rad/s")),
        (Output("theta", "rad"),),
        (*model.parameters, *_HAND),
        in_hand,
    )


def law_program(
    law: str, model: ProcessModel, parameters: FloatArray, constants: list[float]
) -> LawProgram:
    """A law with its constants."""
    step = model_step_of(model, parameters, constants[laws.TIME])
    return LawProgram(
        law, law_text(model), laws.STATES, tuple(constants), tuple(parameters.tolist()), step
    )


def step_matrices(A: FloatArray, h: FloatArray) -> FloatArray:
    """A, Q, F, G, H of ``haptics.model_step`` in steps h, flat: (n_draws, 5 n^2).

    A: (n_draws, n, n). h: (n_draws,) [s].
    """
    n = A.shape[-1]

    def phis(step: FloatArray) -> list[FloatArray]:
        """phi_1, phi_2 and phi_3 of step A: blocks of one exponential."""
        block = np.zeros((len(A), 4 * n, 4 * n))
        block[:, :n, :n] = step[:, None, None] * A
        for k in range(3):
            block[:, k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
        row = expm(block)[:, :n]
        return [row[:, :, k * n : (k + 1) * n] for k in (1, 2, 3)]

    size = h[:, None, None]
    half, _, _ = phis(0.5 * h)
    first, second, third = phis(h)
    Q, F = 0.5 * size * half, size * first
    G, H = size * (2.0 * second - 4.0 * third), size * (4.0 * third - second)
    matrices: FloatArray = np.stack([A, Q, F, G, H], axis=1).reshape(len(A), -1)
    return matrices


def stiff_part(model: ProcessModel, parameters: FloatArray) -> FloatArray:
    """The rows of amplifiers and coils of dx/dt = A x + ..., (n, n), the others zero."""
    x, u = np.zeros(len(model.states)), np.zeros(len(model.inputs))
    A: FloatArray = np.array(linearize(model, x, u, parameters).A)
    A[[model.state_names.index(name) for name in SHAFT]] = 0.0
    A[:, [model.state_names.index(name) for name in SHAFT]] = 0.0
    return A


def model_step_of(model: ProcessModel, parameters: FloatArray, time: float) -> ModelStep:
    """The model's step over samples ``time`` apart [s]."""
    names = model.state_names
    places = names.index("omega"), names.index("theta"), model.input_names.index("torque")
    steps = max(1, math.ceil(time / LONGEST_STEP))
    A = stiff_part(model, parameters)
    matrices = step_matrices(A[None], np.array([time / steps]))[0]
    initial = tuple(model.initial_state.tolist())
    return ModelStep(initial, len(model.inputs), steps, time, places, tuple(matrices.tolist()))


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
