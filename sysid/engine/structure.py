"""Structure of a model's equations: dx/dt = A x + N(x, u), A fixed by the parameters alone.

The batch simulator integrates A exactly, so that only N limits its steps. The parts are found
by running the equations on traces, which write down what is done to them, and not from samples:
a dead zone is never mistaken for a straight line, and the coefficients are exact. A value
clamped from both sides enters A as if it had no limits, and N takes away what they cut off. Where
the equations branch on a value, nothing is claimed to be linear: N is the user's function.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sysid.engine.program import Writer
from sysid.engine.split import Clamp, Split, Splitter
from sysid.engine.tape import Tape
from sysid.engine.trace import followed, operand, traces
from sysid.problem.model import Function, ProcessModel


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
    """

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
    tape = splitter.tape
    derivatives = _splits(splitter, model, model.derivative)
    rows = derivatives or []
    # The clamps of linear values that the rows contain, by their place among all clamps.
    places = sorted({k for row in rows for k in row.kinks})
    clamps = {k: splitter.clamps[k] for k in places if splitter.clamps[k].base.linear}
    parts = [_parts(splitter, row) if exact else ({}, row.total) for row in rows]
    linear = {(i, j): name for i, (row, _) in enumerate(parts) for j, name in row.items()}
    gains = {k: {i: row.kinks[k] for i, row in enumerate(rows) if k in row.kinks} for k in clamps}
    functions = {"remainder": [rest for _, rest in parts]}
    shown = frozenset(model.output_states or range(len(model.states)))
    if model.output is not None:
        outputs = _splits(splitter, model, model.output)
        functions["observe"] = [value.total for value in outputs or ()]
        if outputs is not None:
            shown = frozenset[int]().union(*(value.states for value in outputs))
    if clamps:
        functions["margins"] = [
            tape.emit("{} - {}", clamp.base.total, limit)
            for clamp in clamps.values()
            for limit in clamp.limits
        ]
    names = {*linear.values()}
    for k, clamp in clamps.items():
        names |= {*clamp.base.linear.values(), *gains[k].values()}
    writer = Writer(tape, len(model.parameters), functions, names)
    guards = tuple(
        Guard(len(clamp.limits), writer.placed(clamp.base.linear), writer.placed(gains[k]))
        for k, clamp in clamps.items()
    )
    driven, nonlinear = _driven(model, derivatives if exact else None, clamps)
    return Structure(
        writer.placed(linear), driven, nonlinear, guards, shown, writer.program(),
        len(writer.constants), writer.calls,
    )  # fmt: skip


def _driven(
    model: ProcessModel, rows: Sequence[Split] | None, clamps: Mapping[int, Clamp]
) -> tuple[tuple[int, ...], bool]:
    """Rows of N that change within a sample, and whether any depends on a state."""
    if rows is None:
        return tuple(range(len(model.states))), True
    moving = {j for j, signal in enumerate(model.inputs) if signal.hold != "zoh"}
    nonlinear = [bool(row.nonlinear or row.kinks.keys() & clamps.keys()) for row in rows]
    driven = (i for i, row in enumerate(rows) if nonlinear[i] or row.inputs & moving)
    return tuple(driven), any(nonlinear)


def _splits(splitter: Splitter, model: ProcessModel, function: Function) -> list[Split] | None:
    """The values of a model's function, split; None where traces cannot follow it."""
    equations = Tape()
    sides = zip("xup", (model.states, model.inputs, model.parameters), strict=True)
    try:
        values = followed(function)(*(traces(equations, name, len(items)) for name, items in sides))
        return splitter.split(equations, map(operand, values))
    except Exception:
        # Whatever it does that a trace cannot follow, the compiler may well be able to.
        return None


def _parts(splitter: Splitter, row: Split) -> tuple[Mapping[int, str], str]:
    """Coefficients of a row in A, and its rest in N with all states that enter it nonlinearly."""
    linear = {j: c for j, c in row.linear.items() if j not in row.nonlinear}
    if not linear:
        return {}, row.total
    mixed = splitter.straight({j: c for j, c in row.linear.items() if j in row.nonlinear})
    return linear, splitter.tape.join("+", row.rest, mixed) or "0.0"
