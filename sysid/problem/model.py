"""Grey-box process models: data plus plain-Python functions.

A model is written once, as equations over tuples of floats, and serves every engine: the batch
simulator compiles it to vector code, SciPy integrates it as the reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np

from sysid.arrays import FloatArray
from sysid.time_limit import AT_A_POINT, time_limit

# Elements are floats in a simulation, arrays when a whole population is checked at once.
Function = Callable[..., tuple[Any, ...]]

Scale = Literal["linear", "log"]
Hold = Literal["zoh", "foh", "spline"]
# A value, a range to estimate it in, or a word.
InitialValue = float | tuple[float, float] | Literal["first", "estimate"]

AROUND_FIRST_SAMPLE = (-math.inf, math.inf)


class ModelError(ValueError):
    """A process model or its use is wrong; the message says what and how to mend it.

    >>> try:
    ...     Parameter("R", "ohm", nominal=1.0, lower=0.0, upper=2.0, scale="log")
    ... except ModelError as error:
    ...     print(error)
    parameter R: a log scale needs a positive range, but it starts at 0
    """


@dataclass(frozen=True)
class State:
    """A state: name, unit and the value it starts from when no measurement gives it.

    initial_range: (low, high) in which an unknown initial value is estimated from each record;
    ``AROUND_FIRST_SAMPLE`` reaches as far from the first sample of the output of the same name
    as that output spans in the record. first_sample: whether that sample, where there is one,
    takes precedence over ``initial``.

    >>> State("omega", "rad/s", initial_range=(-1.0, 1.0)).initial
    0.0
    """

    name: str
    unit: str
    initial: float = 0.0
    description: str = ""
    initial_range: tuple[float, float] | None = None
    first_sample: bool = True

    def __post_init__(self) -> None:
        _check_number(
            f"state {self.name}: initial", self.initial,
            "; what is to be estimated has an initial_range=(low, high)",
        )  # fmt: skip
        if self.initial_range is not None and self.initial_range != AROUND_FIRST_SAMPLE:
            if not (isinstance(self.initial_range, Sequence) and len(self.initial_range) == 2):
                raise ModelError(f"state {self.name}: initial_range is no pair (low, high)")
            check_range(f"{self.name}(0)", *self.initial_range)


@dataclass(frozen=True)
class Input:
    """An input and how it runs between samples.

    ``zoh`` holds each sample until the next, ``foh`` interpolates linearly, ``spline`` runs a
    cubic spline through all samples of a record (where a model is advanced sample by sample,
    without knowing what comes, linearly). reaction: a state, and by how much of its rate the
    input is less, as a torque is by an inertia behind its sensor: between samples it bends as that.

    >>> Input("load", "N*m", hold="foh").hold
    'foh'
    """

    name: str
    unit: str
    hold: Hold = "zoh"
    description: str = ""
    reaction: tuple[str, float] | None = None

    def __post_init__(self) -> None:
        _check_choice(f"input {self.name}: hold", self.hold, get_args(Hold))


@dataclass(frozen=True)
class Output:
    """A measured output.

    >>> Output("omega", "rad/s", "shaft speed").unit
    'rad/s'
    """

    name: str
    unit: str
    description: str = ""


@dataclass(frozen=True)
class Parameter:
    """A parameter with its search range and its physical limits.

    ``lower``/``upper`` bound where the search starts (outside is improbable);
    ``minimum``/``maximum`` bound what is physically possible (outside is infeasible).
    A ``fixed`` parameter stays at ``nominal``. ``scale`` is how a range spanning decades is
    searched. ``corrects``: the channel whose error it is, with ``nominal`` for none.

    >>> Parameter("L", "H", nominal=2e-3, lower=2e-4, upper=2e-2, scale="log").minimum
    0.0
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
    corrects: str = ""

    def __post_init__(self) -> None:
        _check_choice(f"parameter {self.name}: scale", self.scale, get_args(Scale))
        if not self.fixed:
            check_range(self.name, self.lower, self.upper, self.scale)
        _check_number(f"parameter {self.name}: nominal value", self.nominal)
        if not self.minimum <= self.nominal <= self.maximum:
            raise ModelError(
                f"parameter {self.name}: nominal value {self.nominal} is outside its physical "
                f"limits [{self.minimum}, {self.maximum}]"
            )


def check_range(name: str, lower: float, upper: float, scale: Scale = "linear") -> None:
    """Raise ModelError unless ``lower < upper``, both finite, and positive on a log scale."""
    if not (_is_finite(lower) and _is_finite(upper)):
        raise ModelError(f"parameter {name}: range [{lower!r}, {upper!r}] is not finite")
    if lower >= upper:
        raise ModelError(
            f"parameter {name}: range [{lower:g}, {upper:g}] has its low end at or above its "
            f"high end; write [low, high]"
        )
    if scale == "log" and lower <= 0.0:
        raise ModelError(
            f"parameter {name}: a log scale needs a positive range, but it starts at {lower:g}"
        )


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _check_number(what: str, value: object, cure: str = "") -> None:
    if not _is_finite(value):
        raise ModelError(f"{what} {value!r} is no finite number{cure}")


def _check_choice(what: str, value: object, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ModelError(f"{what} {value!r} is none of {', '.join(choices)}")


@dataclass(frozen=True)
class Constraint:
    """An inequality g(p) <= 0 on the parameters; ``text`` says it in the field's notation.

    >>> Constraint("J_m <= J_b", lambda p: p[0] - p[1]).function((1.0, 3.0))
    -2.0
    """

    text: str
    function: Callable[[tuple[Any, ...]], Any]


@dataclass(frozen=True, repr=False)
class ProcessModel:
    """Named states, inputs, outputs, parameters, and the functions between them.

    ``derivative(x, u, p)`` takes tuples of floats in the declared order and returns dx/dt as a
    tuple; it may use ``math`` and helper functions of its own. ``output(x, u, p)`` likewise
    returns the outputs; without it each output is the state of the same name.
    ``guesses(records, known)`` reads starting ranges from data, see ``sysid.problem.guesses``.
    ``plots(model, evidence)`` shows more than the outputs, see ``sysid.problem.plots``, and
    ``operating_points(model, records)`` says where to linearise: values of states to hold, by a
    label; without it the mean inputs decide.
    ``regressors(record)`` computes signals that linear baselines may have as inputs, see
    ``sysid.problem.regressors``.
    ``equations`` say to people what the functions compute, one text each, and ``assumptions``
    which constants in them values of parameters rest on. ``variants()`` gives models of the same
    states and inputs that have what this one may lack, by the option that makes them, such as
    ``friction=stribeck``.

    Raises ModelError when names repeat, an output has no state, or a function returns the
    wrong number of values at the nominal parameters.

    >>> lag = ProcessModel(
    ...     name="lag",
    ...     states=(State("y", "V"),),
    ...     inputs=(Input("u", "V"),),
    ...     outputs=(Output("y", "V"),),
    ...     parameters=(Parameter("tau", "s", nominal=0.5, lower=0.1, upper=2.0),),
    ...     derivative=lambda x, u, p: ((u[0] - x[0]) / p[0],),
    ... )
    >>> lag
    <ProcessModel: lag, u -> y, 1 states, 1 parameters>
    >>> lag.derivative((0.0,), (1.0,), (0.5,))
    (2.0,)
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
    regressors: Callable[[Any], Mapping[str, Any]] | None = None
    equations: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    variants: Callable[[], Mapping[str, ProcessModel]] | None = None

    def __repr__(self) -> str:
        signals = f"{', '.join(self.input_names) or 'no input'} -> {', '.join(self.output_names)}"
        sizes = f"{len(self.states)} states, {len(self.parameters)} parameters"
        return f"<ProcessModel: {self.name}, {signals}, {sizes}>"

    def __post_init__(self) -> None:
        several = ("constraints", "equations", "assumptions")
        for kind in ("states", "inputs", "outputs", "parameters", *several):
            items = getattr(self, kind)
            try:
                object.__setattr__(self, kind, tuple(items))
            except TypeError:
                raise ModelError(
                    f"model {self.name}: {kind} is one {type(items).__name__}, not several; "
                    f"write ({type(items).__name__}(...),) with a comma before the bracket"
                ) from None
        for kind in ("states", "inputs", "outputs", "parameters"):
            _check_names(self.name, kind, [item.name for item in getattr(self, kind)])
        for name in self.output_names if self.output is None else ():
            if name not in self.state_names:
                raise ModelError(
                    f"model {self.name}: output {name!r} is not a state; give the model an "
                    f"output function, or name one of its states ({', '.join(self.state_names)})"
                )
        self._try_functions()

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(state.name for state in self.states)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return tuple(signal.name for signal in self.inputs)

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return tuple(signal.name for signal in self.outputs)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def output_states(self) -> tuple[int, ...] | None:
        """Index of each output's state, or None when ``output`` computes them."""
        if self.output is not None:
            return None
        return tuple(self.state_names.index(name) for name in self.output_names)

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
        self._check_exists("parameter", [name], self.parameter_names)
        return self.parameters[self.parameter_names.index(name)]

    def vector(self, values: dict[str, float]) -> FloatArray:
        """Parameters as a vector in declared order; those not named stay nominal."""
        self._check_exists("parameter", values, self.parameter_names)
        return np.array([values.get(p.name, p.nominal) for p in self.parameters])

    def with_parameters(self, **changes: dict[str, Any]) -> ProcessModel:
        """A copy in which parameter ``name`` has the given fields replaced."""
        self._check_exists("parameter", changes, self.parameter_names)
        parameters = tuple(replace(p, **changes.get(p.name, {})) for p in self.parameters)
        return replace(self, parameters=parameters)

    def with_outputs(self, names: Sequence[str]) -> ProcessModel:
        """A copy with these outputs, in this order: outputs of the model, or states of it.

        Raises ModelError for a name that is neither, one given twice, or none at all.
        """
        signals = {s.name: Output(s.name, s.unit, s.description) for s in self.states}
        signals |= {signal.name: signal for signal in self.outputs}
        self._check_exists("output or state", names, signals)
        outputs = tuple(signals[name] for name in names)
        if self.output is None:
            return replace(self, outputs=outputs)
        columns = (*self.output_names, *self.state_names)
        pick = picker([columns.index(name) for name in names]) if names else tuple
        output = self.output
        return replace(
            self, outputs=outputs, output=lambda x, u, p: pick(output(x, u, p) + tuple(x))
        )

    def with_initial(self, starts: Mapping[str, InitialValue]) -> ProcessModel:
        """A copy whose named states start as given, in every record.

        ``"first"``: at the first sample of the output of the same name. A number: there,
        whatever was measured. ``"estimate"``: fitted to each record, within the state's
        declared range or around its first sample. ``(low, high)``: the same within this range.
        Raises ModelError for an unknown state, or a word that its outputs do not allow.
        """
        self._check_exists("state", starts, self.state_names)
        states = tuple(
            self._started(state, starts[state.name]) if state.name in starts else state
            for state in self.states
        )
        return replace(self, states=states)

    def with_holds(self, holds: Mapping[str, Hold]) -> ProcessModel:
        """A copy in which the named inputs are held or interpolated, see ``Input``.

        Raises ModelError for an unknown input.
        """
        self._check_exists("input", holds, self.input_names)
        inputs = tuple(replace(u, hold=holds.get(u.name, u.hold)) for u in self.inputs)
        return replace(self, inputs=inputs)

    def require_ends(self, vectors: FloatArray) -> None:
        """Raise ModelError where an equation does not end at parameters, (n, n_parameters).

        To be tried before a search: once compiled, such code cannot be stopped.
        """
        x, u = tuple(self.initial_state.tolist()), (0.0,) * len(self.inputs)
        for vector in map(tuple, vectors.tolist()):
            for function in filter(None, (self.derivative, self.output)):
                try:
                    with time_limit(AT_A_POINT):
                        function(x, u, vector)
                except TimeoutError as error:
                    values = dict(zip(self.parameter_names, vector, strict=True))
                    raise ModelError(f"model {self.name} at {values}: {error}") from error
                except Exception:
                    pass  # compiled code divides as IEEE 754 does, and goes on

    def _started(self, state: State, start: InitialValue) -> State:
        where = f"state {state.name} of model {self.name}"
        measured = state.name in self.output_names
        if start == "first" and not measured:
            raise ModelError(
                f"{where} is no output, so no sample tells its start; give a value, 'estimate' or "
                "[low, high]"
            )
        if start == "estimate" and not (measured or state.initial_range):
            raise ModelError(
                f"{where} is no output and has no range of its own to estimate its start in; give "
                "one as [low, high]"
            )
        if start == "first":
            return replace(state, initial_range=None, first_sample=True)
        if start == "estimate":
            return replace(state, initial_range=state.initial_range or AROUND_FIRST_SAMPLE)
        if isinstance(start, tuple):
            return replace(state, initial_range=start)
        if isinstance(start, str) or not math.isfinite(start):
            raise ModelError(
                f"state {state.name}: {start!r} is no start; give 'first', 'estimate', a number or "
                "(low, high)"
            )
        return replace(state, initial=float(start), initial_range=None, first_sample=False)

    def _check_exists(self, kind: str, names: Collection[str], existing: Collection[str]) -> None:
        for name in names:
            if name not in existing:
                raise ModelError(
                    f"model {self.name} has no {kind} {name!r}; it has {', '.join(existing)}"
                )

    def _try_functions(self) -> None:
        """Call every function at the nominal parameters, initial states and inputs of zero."""
        x, p = tuple(map(float, self.initial_state)), tuple(map(float, self.nominal))
        u = (0.0,) * len(self.inputs)
        functions = {"derivative": (self.derivative, len(self.states))}
        if self.output is not None:
            functions["output"] = (self.output, len(self.outputs))
        for role, (function, expected) in functions.items():
            where = f"model {self.name}: {role}(x, u, p)"
            values = _call(where, function, x, u, p)
            if not isinstance(values, tuple):
                raise ModelError(f"{where} must return a tuple, not {type(values).__name__}")
            if len(values) != expected:
                raise ModelError(f"{where} returns {len(values)} values, expected {expected}")
        for constraint in self.constraints:
            _call(f"model {self.name}: constraint {constraint.text!r}", constraint.function, p)


def picker(places: Sequence[int]) -> Callable[[Any], tuple[Any, ...]]:
    """A function of a tuple that returns the values at these places, in a form that compiles."""
    first = places[0]
    if len(places) == 1:
        return lambda values: (values[first],)
    rest = picker(places[1:])
    return lambda values: (values[first], *rest(values))


def _check_names(model: str, kind: str, names: list[str]) -> None:
    if not names and kind != "inputs":
        raise ModelError(f"model {model}: it has no {kind}")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ModelError(f"model {model}: {kind} repeat the name {repeated[0]!r}")


def _call(where: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        with time_limit(AT_A_POINT):
            return function(*args)
    except ZeroDivisionError:
        # Compiled code divides as IEEE 754 does; a model singular at rest is still a model.
        raise ModelError(
            f"{where} divides by zero at the nominal parameters, initial state and inputs of 0; "
            "choose other values, or guard the division, as by max(u, 1.0) of what is never below"
        ) from None
    except Exception as error:
        raise ModelError(
            f"{where} fails at the nominal parameters: {type(error).__name__}: {error}"
        ) from error
