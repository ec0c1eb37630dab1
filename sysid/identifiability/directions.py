"""Directions in which parameters and unknown starts move without any output showing it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from flint import arb, ctx

from sysid.arrays import FloatArray
from sysid.identifiability.elimination import Rows, null_space, reduced
from sysid.identifiability.germ import Equations, Point
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
    n_states = len(equations.model.states)
    most = len(free) + 3 * n_states + 2
    cap, prec = ctx.cap, ctx.prec
    try:
        ctx.prec = _BITS
        order = min(most, n_states + 3 + -(-len(free) // len(equations.model.outputs)))
        while True:
            stack = _Stack(equations, parameters, free, records, order)
            elimination = null_space(*stack.rows(n_states + 1), rng)
            if elimination.settled or order == most:
                break
            order = min(most, order + -(-order // 2))
        shown = len(free) + n_shown
        basis = reduced(elimination.basis[:, :shown])
        return TiedDirections(_as_floats(basis * stack.scale[:shown]), elimination.gap)
    finally:
        ctx.cap, ctx.prec = cap, prec


class _Stack:
    """Sensitivities of all records' outputs, each record's starts in columns of their own.

    Columns are in parts of the parameters' and starts' values, ``scale``.
    """

    def __init__(
        self,
        equations: Equations,
        parameters: FloatArray,
        free: Sequence[int],
        records: Sequence[Record],
        order: int,
    ) -> None:
        self._n_outputs, self._order = len(equations.model.outputs), order
        values = [*parameters[list(free)]]
        self._blocks: list[tuple[int, Rows]] = []
        self._n_free = len(free)
        for record in records:
            inputs = record.inputs[:, :order].tolist()
            point = Point(parameters.tolist(), record.start.tolist(), inputs)
            try:
                rows = equations.sensitivities(point, free, record.unknown, order)
            except ArithmeticError:
                rows = []  # it has no power series there, as a root at zero: others must tell
            table = np.array(rows, dtype=object).reshape(len(rows), -1)
            if rows:
                self._blocks.append((len(values), table))
            values += [*record.start[list(record.unknown)]]
        if not self._blocks:
            raise ModelError(
                f"model {equations.model.name}: at no start that was tried do its equations have "
                "a power series in time; declare starts at which roots and divisions are defined"
            )
        self.scale = np.array([arb(v) if v else arb(1) for v in values], dtype=object)

    def rows(self, n_late: int) -> tuple[Rows, Rows]:
        """All rows but those of the last orders, and these."""
        split = (self._order - n_late) * self._n_outputs
        early = [self._widened(place, table[:split]) for place, table in self._blocks]
        late = [self._widened(place, table[split:]) for place, table in self._blocks]
        return np.concatenate(early), np.concatenate(late)

    def _widened(self, place: int, table: Rows) -> Rows:
        wide = np.full((len(table), len(self.scale)), arb(0), dtype=object)
        wide[:, : self._n_free] = table[:, : self._n_free]
        wide[:, place : place + table.shape[1] - self._n_free] = table[:, self._n_free :]
        wide *= self.scale
        return wide


def _as_floats(rows: Rows) -> FloatArray:
    floats = [[float(e.mid()) for e in row] for row in rows]
    table: FloatArray = np.array(floats, dtype=np.float64).reshape(rows.shape)
    return table
