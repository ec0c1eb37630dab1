"""A model's equations together with their variational equations, for noise that drives them.

With noise n on some inputs and w of the process, small against what the equations bend over, the
states deviate by d:

    d' = f_x(x, u) d + f_u(x, u) n(t) + w(t)

Columns of deviations, each from one cause, are integrated as states beside x by the scheme that
integrates x. Since that commutes with differentiation they are, to rounding, the Jacobian of the
simulated step, not an approximation of it. Only states that the noise reaches and that reach an
output have deviations.

White noise w of unit intensity over an interval of length T is a series of independent normal
numbers, each with one of the functions that are orthonormal there (Loeve, "Probability theory"):
with r from 0 to 1 along the interval the first two are 1 / sqrt(T) and sqrt(3 / T) (2 r - 1). Their
response holds the covariance of d up to the fourth power of T over the time constants.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sysid.engine.gradient import differentiate
from sysid.engine.split import Splitter
from sysid.engine.structure import SplitEquations, Structure, structure, traced
from sysid.engine.tape import Tape
from sysid.problem.model import Function, ModelError, ProcessModel

# What a column of deviations comes from: a deviation of a state at the start of the interval, or
# an input's error at the sample where it starts, or at that where it ends, or a state's rate
# throughout the interval, or one that rises from 0 to 1.
Cause = tuple[Literal["state", "begin", "end", "level", "slope"], int]
_OF_RATES = ("level", "slope")
_Slopes = Mapping[tuple[int, int], str]


@dataclass(frozen=True)
class Variation:
    """Structure of the equations with their variational ones, and where deviations stand.

    n_states: of the model. noisy: inputs with noise, by their places. driven: states with noise of
    the process. reached: states with
    deviations. columns: for each cause the places of the deviations among all states, by the state
    that deviates. gains: entries (j, k) of the outputs' slopes that are not always zero, k a
    state's place or behind the states that of a noisy input; their values are what the program's
    function ``gains`` returns, in order. Behind the model's inputs stands one that rises from 0 to
    1 between samples.
    """

    structure: Structure
    n_states: int
    noisy: tuple[int, ...]
    driven: tuple[int, ...]
    reached: tuple[int, ...]
    columns: Mapping[Cause, Mapping[int, int]]
    gains: tuple[tuple[int, int], ...]


def variation(model: ProcessModel, noisy: Sequence[int], driven: Sequence[int] = ()) -> Variation:
    """The equations of a model and of the deviations that noise causes.

    noisy: places of inputs with noise. driven: places of states with noise of the process. Raises
    ModelError for equations that cannot be differentiated without a point: those that branch, look
    up or call what has no known derivative.
    """
    n, m = len(model.states), len(model.inputs)
    tape = Tape()
    rates, slopes = _differentiated(model, tape, model.derivative, noisy)
    gains: _Slopes = dict.fromkeys(enumerate(model.output_states or ()), "1.0")
    outputs: list[str] | None = None
    if model.output is not None:
        outputs, gains = _differentiated(model, tape, model.output, noisy)
    reached = tuple(sorted(_reached(slopes, n, noisy, driven) & _telling(slopes, gains, n)))
    causes = _causes(model, reached, noisy, driven)
    columns: dict[Cause, dict[int, int]] = {}
    place = n
    for cause in causes:
        rows = _moved(slopes, reached, cause, n)
        columns[cause] = {i: place + k for k, i in enumerate(rows)}
        place += len(rows)
    rising = f"u{m}"
    falling = tape.emit("{} - {}", "1.0", rising)
    for cause, column in columns.items():
        kind, k = cause
        held = kind == "begin" and model.inputs[noisy[k]].hold == "zoh"
        share = "1.0" if held or kind == "level" else falling if kind == "begin" else rising
        rates += [_rate(tape, slopes, cause, column, i, n, share) for i in column]
    telling = {k: name for k, name in sorted(gains.items()) if k[1] >= n or k[1] in reached}
    splitter = Splitter()
    rows_of = splitter.split(tape, rates)
    split_outputs = None if outputs is None else splitter.split(tape, outputs)
    moving = {j for j, signal in enumerate(model.inputs) if signal.hold != "zoh"} | {m}
    further = {"gains": splitter.split(tape, telling.values())} if telling else {}
    equations = SplitEquations(place, m + 1, rows_of, split_outputs, frozenset(moving), further)
    whole = structure(model, splitter, equations)
    return Variation(whole, n, tuple(noisy), tuple(driven), reached, columns, tuple(telling))


def _differentiated(
    model: ProcessModel, tape: Tape, function: Function, noisy: Sequence[int]
) -> tuple[list[str], _Slopes]:
    """A function's values on a tape, and their slopes over states and then noisy inputs."""
    variables = [f"x{i}" for i in range(len(model.states))] + [f"u{j}" for j in noisy]
    try:
        names = traced(tape, model, function)
        moves = {name: {k: "1.0"} for k, name in enumerate(variables)}
        return names, differentiate(tape, names, moves)
    except Exception as error:
        # Whatever a function may do that traces cannot follow.
        raise not_differentiable(model, error) from error


def not_differentiable(model: ProcessModel, error: Exception) -> ModelError:
    """What to say of equations that cannot be differentiated without a point."""
    return ModelError(
        f"model {model.name}: its equations cannot be differentiated as they stand ({error}); "
        "write conditions with abs, min, max and functions of math"
    )


def _reached(slopes: _Slopes, n: int, noisy: Sequence[int], driven: Sequence[int]) -> set[int]:
    """States that the noise reaches."""
    sources = range(n, n + len(noisy))
    first = {i for i, k in slopes if k in sources} | {*driven}
    return _closed(first, ((k, i) for i, k in slopes if k < n))


def _telling(slopes: _Slopes, gains: _Slopes, n: int) -> set[int]:
    """States that reach an output."""
    return _closed({k for _, k in gains if k < n}, ((i, k) for i, k in slopes if k < n))


def _moved(slopes: _Slopes, reached: Sequence[int], cause: Cause, n: int) -> list[int]:
    """States that a cause moves, among those that are reached."""
    kind, k = cause
    direct = kind == "state" or kind in _OF_RATES
    first = {k} if direct else {i for i, j in slopes if j == n + k}
    moved = _closed(first & {*reached}, ((j, i) for i, j in slopes if i in reached and j < n))
    return [i for i in reached if i in moved]


def _closed(first: set[int], arrows: Iterator[tuple[int, int]]) -> set[int]:
    """All that arrows (from, to) lead to from the first ones."""
    every, closed = list(arrows), set(first)
    while more := {to for begin, to in every if begin in closed} - closed:
        closed |= more
    return closed


def _causes(
    model: ProcessModel, reached: Sequence[int], noisy: Sequence[int], driven: Sequence[int]
) -> list[Cause]:
    causes: list[Cause] = [("state", i) for i in reached]
    for k, j in enumerate(noisy):
        causes.append(("begin", k))
        if model.inputs[j].hold != "zoh":
            causes.append(("end", k))
    for i in driven:
        causes += [("level", i), ("slope", i)]
    return causes


def _rate(
    tape: Tape, slopes: _Slopes, cause: Cause, column: Mapping[int, int], i: int, n: int, share: str
) -> str:
    """Rate of the deviation of state i by a cause; share: of an input's error that acts now."""
    total: str | None = None
    for j, place in column.items():
        if (i, j) in slopes:
            total = tape.join("+", total, tape.multiply(slopes[i, j], f"x{place}"))
    kind, k = cause
    if kind in _OF_RATES and i == k:
        total = tape.join("+", total, share)
    if kind in ("begin", "end") and (i, n + k) in slopes:
        total = tape.join("+", total, tape.multiply(slopes[i, n + k], share))
    return total or "0.0"
