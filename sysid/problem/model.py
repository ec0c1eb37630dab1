"""Description of a grey-box process model: data plus plain-Python functions.

A model is written once, as equations over tuples of floats, and serves every engine: the batch
simulator compiles it to vector code, SciPy integrates it as the reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from sysid.arrays import FloatArray

# Elements are floats in a simulation, arrays when a whole population is checked at once.
Function = Callable[..., tuple[Any, ...]]

Scale = Literal["linear", "log"]
Hold = Literal["zoh", "foh", "spline"]
# A value, a range to estimate it in, or a word.
Start = float | tuple[float, float] | Literal["first", "estimate"]

AROUND_FIRST_SAMPLE = (-math.inf, math.inf)


class ModelError(ValueError):
    """A process model or its use is wrong; the message says what and how to mend it."""


@dataclass(frozen=True)
class State:
    """One state: name, unit and the value it starts from when no measurement gives it.

    initial_range: (low, high) where that value is unknown and to be estimated from each record;
    ``AROUND_FIRST_SAMPLE`` for as far from the first sample of the output of the same name as
    that output spans in the record. first_sample: whether that sample, where there is one, goes
    before ``initial``.
    """

    name: str
    unit: str
    initial: float = 0.0
    description: str = ""
    initial_range: tuple[float, float] | None = None
    first_sample: bool = True

    def __post_init__(self) -> None:
        if self.initial_range is not None and self.initial_range != AROUND_FIRST_SAMPLE:
            check_range(f"{self.name}(0)", *self.initial_range)


@dataclass(frozen=True)
class Input:
    """One input and how it runs between samples.

    ``zoh`` holds each sample until the next, ``foh`` interpolates linearly, ``spline`` runs a
    cubic spline through all samples of a record (where a model is advanced sample by sample,
    without knowing what comes, linearly).
    """

    name: str
    unit: str
    hold: Hold = "zoh"
    description: str = ""


@dataclass(frozen=True)
class Output:
    """One measured output."""

    name: str
    unit: str
    description: str = ""


@dataclass(frozen=True)
class Parameter:
    """One parameter with its search range and its physical limits.

    ``lower``/``upper`` bound where the search starts (outside is improbable);
    ``minimum``/``maximum`` bound what is physically possible (outside is infeasible).
    A ``fixed`` parameter stays at ``nominal``. ``scale`` is how a range spanning decades is
    searched.
    """

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    scale: Scale = "linear"
    fixed: bool = False
    minimum: float = 0.0
    maximum: float = math.inf
    description: str = ""

    def __post_init__(self) -> None:
        if not self.fixed:
            check_range(self.name, self.lower, self.upper, self.scale)
        if not math.isfinite(self.nominal):
            raise ModelError(f"parameter {self.name}: nominal value {self.nominal} is not finite")
        if not self.minimum <= self.nominal <= self.maximum:
            raise ModelError(
                f"parameter {self.name}: nominal value {self.nominal} is outside its physical "
                f"limits [{self.minimum}, {self.maximum}]"
            )


def check_range(name: str, lower: float, upper: float, scale: Scale = "linear") -> None:
    """Raise ModelError unless ``lower < upper``, both finite, and positive on a log scale."""
    if not (math.isfinite(lower) and math.isfinite(upper)):
        raise ModelError(f"parameter {name}: range [{lower}, {upper}] is not finite")
    if lower >= upper:
        raise ModelError(
            f"parameter {name}: range [{lower:g}, {upper:g}] has its low end at or above its "
            f"high end; write [low, high]"
        )
    if scale == "log" and lower <= 0.0:
        raise ModelError(
            f"parameter {name}: a log scale needs a positive range, but it starts at {lower:g}"
        )


@dataclass(frozen=True)
class Constraint:
    """An inequality g(p) <= 0 on the parameters; ``text`` says it in the field's notation."""

    text: str
    function: Callable[[tuple[Any, ...]], Any]


@dataclass(frozen=True)
class ProcessModel:
    """Named states, inputs, outputs, parameters, and the functions between them.

    ``derivative(x, u, p)`` takes tuples of floats in the declared order and returns dx/dt as a
    tuple; it may use ``math`` and helper functions of its own. ``output(x, u, p)`` likewise
    returns the outputs; without it each output is the state of the same name.
    ``guesses(records, known)`` reads starting ranges from data, see ``sysid.problem.guesses``.
    ``plots(model, evidence)`` shows more than the outputs, see ``sysid.problem.plots``, and
    ``operating_points(model, records)`` says where to linearise: values of states to hold, by a
    label; without it the mean inputs decide.
    ``equations`` say to people what the functions compute, one text each.

    Raises ModelError when names repeat, an output has no state, or a function returns the
    wrong number of values at the nominal parameters.
    """

    name: str
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    derivative: Function
    output: Function | None = None
    constraints: tuple[Constraint, ...] = ()
    description: str = ""
    guesses: Callable[[Any, Any], Mapping[str, Any]] | None = None
    plots: Callable[[Any, Any], Iterable[Any]] | None = None
    operating_points: Callable[[Any, Any], Mapping[str, Mapping[str, float]]] | None = None
    equations: tuple[str, ...] = ()
    _output_states: tuple[int, ...] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        for kind in ("states", "inputs", "outputs", "parameters", "constraints", "equations"):
            object.__setattr__(self, kind, _several(self.name, kind, getattr(self, kind)))
        for kind in ("states", "inputs", "outputs", "parameters"):
            _check_names(self.name, kind, [item.name for item in getattr(self, kind)])
        if self.output is None:
            object.__setattr__(self, "_output_states", self._match_outputs())
        self._try_functions()

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(state.name for state in self.states)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return tuple(signal.name for signal in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return tuple(signal.name for signal in self.outputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def output_states(self) -> tuple[int, ...] | None:
        """Index of each output's state, or None when ``output`` computes them."""
        return self._output_states

    @property
    def nominal(self) -> FloatArray:
        """Nominal parameters, shape (n_parameters,)."""
        return np.array([parameter.nominal for parameter in self.parameters])

    @property
    def initial_state(self) -> FloatArray:
        """Declared initial states, shape (n_states,)."""
        return np.array([state.initial for state in self.states])

    def parameter(self, name: str) -> Parameter:
        """The parameter called ``name``; raises ModelError naming those that exist."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise ModelError(
            f"model {self.name} has no parameter {name!r}; it has "
            + ", ".join(self.parameter_names)
        )

    def vector(self, values: dict[str, float]) -> FloatArray:
        """Parameters as a vector in declared order; those not named stay nominal."""
        for name in values:
            self.parameter(name)
        return np.array([values.get(p.name, p.nominal) for p in self.parameters])

    def with_parameters(self, **changes: dict[str, Any]) -> ProcessModel:
        """A copy in which parameter ``name`` has the given fields replaced."""
        for name in changes:
            self.parameter(name)
        parameters = tuple(replace(p, **changes.get(p.name, {})) for p in self.parameters)
        return replace(self, parameters=parameters)

    def with_outputs(self, names: Sequence[str]) -> ProcessModel:
        """A copy with these outputs, in this order: outputs of the model, or states of it.

        Raises ModelError for a name that is neither, one given twice, or none at all.
        """
        own = {signal.name: signal for signal in self.outputs}
        states = {s.name: Output(s.name, s.unit, s.description) for s in self.states}
        known = states | own
        for name in names:
            if name not in known:
                raise ModelError(
                    f"model {self.name} has no output or state {name!r}; it has {', '.join(known)}"
                )
        outputs = tuple(known[name] for name in names)
        if self.output is None:
            return replace(self, outputs=outputs)
        everything = [*own, *self.state_names]
        pick = picker([everything.index(name) for name in names]) if names else tuple
        output = self.output
        return replace(
            self, outputs=outputs, output=lambda x, u, p: pick(output(x, u, p) + tuple(x))
        )

    def with_initial(self, starts: Mapping[str, Start]) -> ProcessModel:
        """A copy in which the named states start as told, in every record.

        ``"first"``: at the first sample of the output of the same name. A number: there,
        whatever was measured. ``"estimate"``: fitted to each record, within the state's own
        range or around its first sample. ``(low, high)``: the same within this range. Raises
        ModelError for an unknown state, or a word that its outputs do not allow.
        """
        for name in starts:
            if name not in self.state_names:
                raise ModelError(
                    f"model {self.name} has no state {name!r}; it has {', '.join(self.state_names)}"
                )
        states = tuple(
            self._started(state, starts[state.name]) if state.name in starts else state
            for state in self.states
        )
        return replace(self, states=states)

    def with_holds(self, holds: Mapping[str, Hold]) -> ProcessModel:
        """A copy in which the named inputs are held or interpolated, see ``Input``.

        Raises ModelError for an unknown input.
        """
        for name in holds:
            if name not in self.input_names:
                raise ModelError(
                    f"model {self.name} has no input {name!r}; it has {', '.join(self.input_names)}"
                )
        inputs = tuple(replace(u, hold=holds.get(u.name, u.hold)) for u in self.inputs)
        return replace(self, inputs=inputs)

    def _started(self, state: State, start: Start) -> State:
        measured = state.name in self.output_names
        if start == "first":
            if not measured:
                raise ModelError(
                    f"state {state.name} of model {self.name} is no output, so no sample tells its "
                    "start; give a value, 'estimate' or [low, high]"
                )
            return replace(state, initial_range=None, first_sample=True)
        if start == "estimate":
            if state.initial_range is None and not measured:
                raise ModelError(
                    f"state {state.name} of model {self.name} is no output and has no range of its "
                    "own to estimate its start in; give one as [low, high]"
                )
            return replace(state, initial_range=state.initial_range or AROUND_FIRST_SAMPLE)
        if isinstance(start, tuple):
            return replace(state, initial_range=start)
        if isinstance(start, str) or not math.isfinite(start):
            raise ModelError(
                f"state {state.name}: {start!r} is no start; give 'first', 'estimate', a number or "
                "(low, high)"
            )
        return replace(state, initial=float(start), initial_range=None, first_sample=False)

    def evaluate_output(
        self, x: Sequence[Any], u: Sequence[Any], p: Sequence[Any]
    ) -> tuple[Any, ...]:
        """Outputs at one point; arrays of equal shape may stand in place of floats."""
        if self.output is not None:
            return self.output(tuple(x), tuple(u), tuple(p))
        assert self._output_states is not None
        return tuple(x[i] for i in self._output_states)

    def _match_outputs(self) -> tuple[int, ...]:
        missing = [name for name in self.output_names if name not in self.state_names]
        if missing:
            raise ModelError(
                f"model {self.name}: output {missing[0]!r} is not a state; give the model an "
                f"output function, or name one of its states ({', '.join(self.state_names)})"
            )
        return tuple(self.state_names.index(name) for name in self.output_names)

    def _try_functions(self) -> None:
        x = tuple(float(v) for v in self.initial_state)
        u = (0.0,) * len(self.inputs)
        p = tuple(float(v) for v in self.nominal)
        self._try("derivative", self.derivative, len(self.states), x, u, p)
        if self.output is not None:
            self._try("output", self.output, len(self.outputs), x, u, p)
        for constraint in self.constraints:
            _call(f"model {self.name}: constraint {constraint.text!r}", constraint.function, p)

    def _try(self, role: str, function: Function, expected: int, *args: tuple[float, ...]) -> None:
        where = f"model {self.name}: {role}(x, u, p)"
        values = _call(where, function, *args)
        if not isinstance(values, tuple):
            raise ModelError(f"{where} must return a tuple, not {type(values).__name__}")
        if len(values) != expected:
            raise ModelError(f"{where} returns {len(values)} values, expected {expected}")


def _several(model: str, kind: str, items: Any) -> tuple[Any, ...]:
    try:
        return tuple(items)
    except TypeError:
        raise ModelError(
            f"model {model}: {kind} is one {type(items).__name__}, not several; "
            f"write ({type(items).__name__}(...),) with a comma before the bracket"
        ) from None


def picker(places: Sequence[int]) -> Callable[[Any], tuple[Any, ...]]:
    """A function of a tuple that returns some of its values, in a form that compiles."""
    first = places[0]
    if len(places) == 1:
        return lambda values: (values[first],)
    rest = picker(places[1:])
    return lambda values: (values[first], *rest(values))


def _call(where: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        return function(*args)
    except ZeroDivisionError:
        # Compiled code divides as IEEE 754 does; a model singular at rest is still a model.
        raise ModelError(
            f"{where} divides by zero at the nominal parameters and initial state; "
            f"choose other nominal values or guard the division"
        ) from None
    except Exception as error:
        raise ModelError(
            f"{where} fails at the nominal parameters: {type(error).__name__}: {error}"
        ) from error


def _check_names(model: str, kind: str, names: list[str]) -> None:
    if not names and kind in ("states", "outputs", "parameters"):
        raise ModelError(f"model {model}: it has no {kind}")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ModelError(f"model {model}: {kind} repeat the name {repeated[0]!r}")
