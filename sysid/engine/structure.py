"""Structure of a model's equations: dx/dt = A x + N(x, u), A fixed by the parameters alone.

The batch simulator integrates A exactly, so that only N limits its steps. The parts are found
by running the equations on traces, which write down what is done to them, and not from samples:
a dead zone is never mistaken for a straight line, and the coefficients are exact. A value
clamped from both sides enters A as if it had no limits, and N takes away what they cut off. Where
the equations branch on a value, nothing is claimed to be linear: N is the user's function.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sysid.engine.program import Writer
from sysid.engine.split import Clamp, Split, Splitter
from sysid.engine.tape import Tape, UndecidedError
from sysid.engine.trace import followed, operand, traces
from sysid.problem.model import Function, ProcessModel

_MOST_WAYS = 256  # through the conditions of a function


@dataclass(frozen=True)
class Guard:
    """A linear value that the equations clamp between limits.

    n_limits: how many of the program's ``margins`` belong to it. slopes: its coefficients by
    state. gains: its coefficients in the rows of dx/dt. Coefficients are text as in Structure.
    """

    n_limits: int
    slopes: Mapping[int, str]
    gains: Mapping[int, str]


@dataclass(frozen=True)
class Structure:
    """What is linear in dx/dt = A x + N(x, u).

    coefficients: entries (i, j) of A that are not always zero, as Python text in terms of the
    program's n_constants constants ``c[..]``. driven: rows whose N changes within a sample:
    nonlinear ones, and those with an input that is not held. nonlinear: whether any row of N
    depends on a state. guards: limits that fast linear parts may run into. shown: states that an
    output depends on directly, so that an error in one of them shows there. program: source text,
    see ``Writer.program``. calls: which of ``derivative`` and ``output`` the program refers to.
    n_states, n_inputs, n_parameters: how many the program takes; n_outputs: how many it gives,
    where output_states, the state that each output is, is None.
    """

    n_states: int
    n_inputs: int
    n_parameters: int
    n_outputs: int
    output_states: tuple[int, ...] | None
    coefficients: Mapping[tuple[int, int], str]
    driven: tuple[int, ...]
    nonlinear: bool
    guards: tuple[Guard, ...]
    shown: frozenset[int]
    program: str
    n_constants: int
    calls: frozenset[str]


def analyse(model: ProcessModel, *, exact: bool = True) -> Structure:
    """Take a model's equations apart; without ``exact`` all of them are left in N."""
    splitter = Splitter()
    rows = _splits(splitter, model, model.derivative)
    outputs = None if model.output is None else _splits(splitter, model, model.output) or ()
    moving = frozenset(j for j, signal in enumerate(model.inputs) if signal.hold != "zoh")
    equations = SplitEquations(len(model.states), len(model.inputs), rows, outputs, moving)
    return structure(model, splitter, equations, exact=exact)


@dataclass(frozen=True)
class SplitEquations:
    """Derivatives and outputs, split; moving: inputs that change within a sample.

    rows: None where they could not be followed; outputs: None where they are states, empty where
    they could not be followed. further: functions of the program beside those, by name.
    """

    n_states: int
    n_inputs: int
    rows: Sequence[Split] | None
    outputs: Sequence[Split] | None
    moving: frozenset[int]
    further: Mapping[str, Sequence[Split]] = field(default_factory=dict)


def structure(
    model: ProcessModel, splitter: Splitter, equations: SplitEquations, *, exact: bool = True
) -> Structure:
    """The structure of split equations, those of a model or such as contain them."""
    tape, rows, outputs = splitter.tape, equations.rows or (), equations.outputs
    # The clamps of linear values that the rows contain, by their place among all clamps.
    places = sorted({k for row in rows for k in row.kinks})
    clamps = {k: splitter.clamps[k] for k in places if splitter.clamps[k].base.linear}
    pieces = [parts(splitter, row) if exact else ({}, row.total) for row in rows]
    linear = {(i, j): name for i, (row, _) in enumerate(pieces) for j, name in row.items()}
    gains = {k: {i: row.kinks[k] for i, row in enumerate(rows) if k in row.kinks} for k in clamps}
    functions = {"remainder": [rest for _, rest in pieces]}
    shown = frozenset(model.output_states or range(len(model.states)))
    if outputs is not None:
        functions["observe"] = [value.total for value in outputs]
        if outputs:
            shown = frozenset[int]().union(*(value.states for value in outputs))
    if clamps:
        functions["margins"] = [
            tape.emit("{} - {}", clamp.base.total, limit)
            for clamp in clamps.values()
            for limit in clamp.limits
        ]
    functions |= {
        name: [value.total for value in values] for name, values in equations.further.items()
    }
    names = {*linear.values()}
    for k, clamp in clamps.items():
        names |= {*clamp.base.linear.values(), *gains[k].values()}
    writer = Writer(tape, len(model.parameters), functions, names)
    guards = tuple(
        Guard(len(clamp.limits), writer.placed(clamp.base.linear), writer.placed(gains[k]))
        for k, clamp in clamps.items()
    )
    driven, nonlinear = _driven(equations, clamps, exact)
    return Structure(
        equations.n_states, equations.n_inputs, len(model.parameters), len(model.outputs),
        model.output_states, writer.placed(linear), driven, nonlinear, guards, shown,
        writer.program(), len(writer.constants), writer.calls,
    )  # fmt: skip


def _driven(
    equations: SplitEquations, clamps: Mapping[int, Clamp], exact: bool
) -> tuple[tuple[int, ...], bool]:
    """Rows of N that change within a sample, and whether any depends on a state."""
    rows = equations.rows
    if rows is None or not exact:
        return tuple(range(equations.n_states)), True
    nonlinear = [bool(row.nonlinear or row.kinks.keys() & clamps.keys()) for row in rows]
    driven = (i for i, row in enumerate(rows) if nonlinear[i] or row.inputs & equations.moving)
    return tuple(driven), any(nonlinear)


def _splits(splitter: Splitter, model: ProcessModel, function: Function) -> list[Split] | None:
    """The values of a model's function, split; None where traces cannot follow it."""
    try:
        return split_function(splitter, model, function)
    except Exception:
        # Whatever it does that a trace cannot follow, the compiler may well be able to.
        return None


def split_function(
    splitter: Splitter, model: ProcessModel, function: Function, *, branches: bool = False
) -> list[Split]:
    """The values of a model's function, split; raises what it does that traces cannot follow.

    branches: whether it may have conditions, of which both ways are followed.
    """
    equations = Tape()
    follow = branching if branches else traced
    return splitter.split(equations, follow(equations, model, function))


def branching(tape: Tape, model: ProcessModel, function: Function) -> list[str]:
    """As ``traced``, with the values of both ways of each condition, and a choice of them."""
    ways = 0

    def follow(decisions: Mapping[str, bool]) -> list[str]:
        nonlocal ways
        ways += 1
        if ways > _MOST_WAYS:
            raise TypeError(f"its conditions lead more than {_MOST_WAYS} ways")
        tape.decisions = dict(decisions)
        try:
            return traced(tape, model, function)
        except UndecidedError as undecided:
            condition = undecided.name
        true, false = (follow({**decisions, condition: outcome}) for outcome in (True, False))
        return [
            a if a == b else tape.emit("select({}, {}, {})", condition, a, b)
            for a, b in zip(true, false, strict=True)
        ]

    return follow({})


def traced(tape: Tape, model: ProcessModel, function: Function) -> list[str]:
    """Names on a tape of the values of a model's function; raises what traces cannot follow."""
    sides = zip("xup", (model.states, model.inputs, model.parameters), strict=True)
    values = followed(function)(*(traces(tape, name, len(items)) for name, items in sides))
    return [operand(value) for value in values]


def parts(splitter: Splitter, row: Split) -> tuple[Mapping[int, str], str]:
    """Coefficients of a row in A, and its rest in N with all states that enter it nonlinearly."""
    linear = {j: c for j, c in row.linear.items() if j not in row.nonlinear}
    if not linear:
        return {}, row.total
    mixed = splitter.straight({j: c for j, c in row.linear.items() if j in row.nonlinear})
    return linear, splitter.tape.join("+", row.rest, mixed) or "0.0"
