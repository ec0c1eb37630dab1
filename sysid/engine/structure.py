"""A model's equations taken apart: dx/dt = A x + N(x, u), and what depends on parameters alone.

The batch simulator integrates A exactly, so that only N limits its steps. The parts are found
by running the equations on numbers that write down what is done to them, not from samples of
their values: a dead zone is never mistaken for a straight line, and the coefficients are exact.
A value limited from both sides counts with its straight piece in A, which makes its row exact
while it is not at a limit; N is what is left, zero until then. Where the equations branch on a
value nothing is claimed to be linear, and N is the user's function itself.
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
    """A number within a straight piece of which the equations have limits.

    n_limits: how many of the program's ``margins`` are its own. slopes: its coefficients by
    state. gains: by row, what the number counts for there. Coefficients are text as in Structure.
    """

    n_limits: int
    slopes: Mapping[int, str]
    gains: Mapping[int, str]


@dataclass(frozen=True)
class Structure:
    """What is linear in dx/dt = A x + N(x, u).

    coefficients: of the entries (i, j) of A that are not always zero, each as Python text in
    terms of the constants ``c[..]`` of the program, n_constants of them. driven: rows whose N
    changes within a sample: nonlinear ones, and those with an input that is not held. nonlinear:
    whether any row of N depends on a state. guards: limits that fast linear parts may run into.
    shown: states that an output depends on directly, so that it shows when one of them is wrong.
    program: see ``program``. calls: which of ``derivative`` and ``output`` it refers to.
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
    slopes = _splits(splitter, model, model.derivative)
    rows = slopes or []
    # Limits on straight pieces that the rows are sums of, by their place among all.
    places = sorted({k for row in rows for k in row.kinks})
    clamps = {k: splitter.clamps[k] for k in places if splitter.clamps[k].base.linear}
    parts = [_parts(splitter, row) if exact else ({}, row.total) for row in rows]
    linear = {(i, j): name for i, (piece, _) in enumerate(parts) for j, name in piece.items()}
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
    driven, nonlinear = _driven(model, slopes if exact else None, clamps)
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
    bent = [bool(row.nonlinear or row.kinks.keys() & clamps.keys()) for row in rows]
    return tuple(i for i, row in enumerate(rows) if bent[i] or row.inputs & moving), any(bent)


def _splits(splitter: Splitter, model: ProcessModel, function: Function) -> list[Split] | None:
    """A function's values, split; None where it cannot be followed."""
    equations = Tape()
    sides = zip("xup", (model.states, model.inputs, model.parameters), strict=True)
    try:
        values = followed(function)(*(traces(equations, name, len(of)) for name, of in sides))
        return splitter.split(equations, map(operand, values))
    except Exception:
        # Whatever it does that a trace cannot follow, the compiler may well be able to.
        return None


def _parts(splitter: Splitter, row: Split) -> tuple[Mapping[int, str], str]:
    """Straight piece of a row, without the states it depends on in other ways, and the rest."""
    linear = {j: c for j, c in row.linear.items() if j not in row.nonlinear}
    if not linear:
        return {}, row.total
    mixed = splitter.straight({j: c for j, c in row.linear.items() if j in row.nonlinear})
    return linear, splitter.tape.join("+", row.rest, mixed) or "0.0"
