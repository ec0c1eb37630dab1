"""Directions in which parameters and unknown starts move without any output showing it."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from flint import arb, ctx

from sysid.arrays import FloatArray
from sysid.identifiability.elimination import Elimination, Rows, null_space, reduced
from sysid.identifiability.germ import Equations, ExpansionPoint
from sysid.identifiability.records import Record, RecordPlan
from sysid.problem.model import ModelError, ProcessModel

_BITS = 1024  # of every number
_SEED = 20090511


class TiedDirections(NamedTuple):
    """What the outputs do not show at a point.

    basis: (k, n_columns), changes of the free parameters and then of the unknown starts, record
    by record. gap: decades between what is not zero and what is taken for it.
    """

    basis: FloatArray
    gap: float


def null_directions(
    model: ProcessModel,
    parameters: FloatArray,
    free: Sequence[str],
    unknown_starts: Sequence[str] = (),
    starts: FloatArray | None = None,
) -> FloatArray:
    """Directions that leave every output of every record alone, (k, n_free + n_starts).

    parameters: (n_parameters,), the point, in the model's units. free: names of the parameters
    that may change. unknown_starts: names of the states whose starts may, too; the other states
    begin at their first sample if they are measured, else where the model declares. starts:
    (n_records, n_unknown), their values; then the columns behind the parameters are those of
    record after record, as in ``SearchSpace.with_starts``. Without it there is one record whose
    unknown starts are drawn.

    Each row has a one in a column of its own, in units of the value that stands there, and as many
    zeros as elimination gives. Inputs are any functions of time, so no log enters. Raises
    ModelError where the equations cannot be followed.

    >>> from sysid.examples import lag
    >>> null_directions(lag(), lag().nominal, ["gain", "tau"]).shape
    (0, 2)
    """
    for name in free:
        model.parameter(name)
    equations, point = Equations(model), np.asarray(parameters, dtype=np.float64)
    places = [model.parameter_names.index(name) for name in free]
    unknown = [model.state_names.index(name) for name in unknown_starts]
    rng = np.random.default_rng(_SEED)
    records = RecordPlan(equations, unknown, rng).records(point, starts)
    n_shown = len(unknown) * (1 if starts is None else len(starts))
    return directions_at(equations, point, places, records, n_shown, rng).basis


def directions_at(
    equations: Equations,
    parameters: FloatArray,
    free: Sequence[int],
    records: Sequence[Record],
    n_shown: int,
    rng: np.random.Generator,
) -> TiedDirections:
    """The same by places of the parameters, of given records.

    n_shown: how many of the records' unknown starts, the first of them, the directions name.
    """
    with _precision():
        stack, elimination = _settled(equations, parameters, free, records, rng)
        shown = len(free) + n_shown
        basis = reduced(elimination.basis[:, :shown])
        return TiedDirections(_as_floats(basis * stack.scale[:shown]), elimination.gap)


def telling_records(
    equations: Equations,
    parameters: FloatArray,
    free: Sequence[int],
    records: Sequence[Record],
    rng: np.random.Generator,
) -> list[Record]:
    """The first record, whose start may be anywhere, and those that tell all without it."""
    with _precision():
        stack, _ = _settled(equations, parameters, free, records, rng)
        kept: list[int] = []
        least = len(free) + 1
        for k in range(1, len(records)):
            basis = null_space(*stack.rows([*kept, k]), rng).basis
            n_tied = len(reduced(basis[:, : len(free)]))
            if n_tied < least:
                kept, least = [*kept, k], n_tied
    return [records[k] for k in (0, *kept)]


def _settled(
    equations: Equations,
    parameters: FloatArray,
    free: Sequence[int],
    records: Sequence[Record],
    rng: np.random.Generator,
) -> tuple["_Stack", Elimination]:
    """Sensitivities of so many orders that further ones would add nothing, and their null space."""
    n_states = len(equations.model.states)
    most = len(free) + 3 * n_states + 2
    order = min(most, n_states + 3 + -(-len(free) // len(equations.model.outputs)))
    while True:
        stack = _Stack(equations, parameters, free, records, order)
        elimination = null_space(*stack.rows(range(len(records))), rng)
        if elimination.settled or order == most:
            return stack, elimination
        order = min(most, order + -(-order // 2))


@contextmanager
def _precision() -> Iterator[None]:
    """Within it numbers have all their bits; series are as long as they are set to be."""
    cap, prec = ctx.cap, ctx.prec
    ctx.prec = _BITS
    try:
        yield
    finally:
        ctx.cap, ctx.prec = cap, prec


class _Stack:
    """Sensitivities of several records' outputs, each record's starts in columns of their own.

    Columns are in parts of the parameters' and starts' values; scale: those of the parameters,
    then of each record's starts.
    """

    def __init__(
        self,
        equations: Equations,
        parameters: FloatArray,
        free: Sequence[int],
        records: Sequence[Record],
        order: int,
    ) -> None:
        n_late = len(equations.model.states) + 1
        self._n_early = (order - n_late) * len(equations.model.outputs)
        self._n_free = len(free)
        self._tables: list[Rows] = []
        values = [*parameters[list(free)]]
        for record in records:
            inputs = record.inputs[:, :order].tolist()
            point = ExpansionPoint(parameters.tolist(), record.start.tolist(), inputs)
            try:
                rows = equations.sensitivities(point, free, record.unknown, order)
            except ArithmeticError:
                rows = []  # it has no power series there, as a root at zero: others must tell
            starts = record.start[list(record.unknown)]
            table = np.array(rows, dtype=object).reshape(len(rows), len(free) + len(starts))
            self._tables.append(table * _scale([*parameters[list(free)], *starts]))
            values += [*starts]
        self.scale = _scale(values)
        if not any(map(len, self._tables)):
            raise ModelError(
                f"model {equations.model.name}: at no start that was tried do its equations have "
                "a power series in time; declare starts at which roots and divisions are defined"
            )

    def rows(self, records: Sequence[int]) -> tuple[Rows, Rows]:
        """Rows of some of the records, all but those of the last orders, and these."""
        n = self._n_free
        width = n + sum(self._tables[k].shape[1] - n for k in records)
        early, late, place = [np.zeros((0, width), object)], [np.zeros((0, width), object)], n
        for k in records:
            table = self._tables[k]
            wide = np.full((len(table), width), arb(0), dtype=object)
            wide[:, :n] = table[:, :n]
            end = place + table.shape[1] - n
            wide[:, place:end] = table[:, n:]
            place = end
            early.append(wide[: self._n_early])
            late.append(wide[self._n_early :])
        return np.concatenate(early), np.concatenate(late)


def _scale(values: Sequence[float]) -> Rows:
    return np.array([arb(value) if value else arb(1) for value in values], dtype=object)


def _as_floats(rows: Rows) -> FloatArray:
    floats = [[float(e.mid()) for e in row] for row in rows]
    table: FloatArray = np.array(floats, dtype=np.float64).reshape(rows.shape)
    return table
