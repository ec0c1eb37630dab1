"""How outputs begin: their power series in time, and how these move with parameters and starts.

The states follow dx/dt = f(x, u, p) as power series, by Picard's iteration, which gains an order
a turn. Their sensitivities S = dx/d(p, x0) follow the variational equation dS/dt = f_x S + f_p.
Conditions are decided by how a number begins, so that a start on a kink goes the way that the
equations leave it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flint import arb, arb_mat, arb_series, ctx

from sysid.engine.gradient import differentiate
from sysid.engine.tape import Tape
from sysid.engine.trace import followed, operand, traces
from sysid.identifiability.series import coefficients, series_operation
from sysid.problem.model import ModelError, ProcessModel

_PATIENCE = 3  # times as many turns as orders before conditions that flicker are given up


@dataclass(frozen=True)
class ExpansionPoint:
    """Where outputs are expanded: parameters (n_parameters,), start (n_states,), inputs.

    inputs: (n_inputs, n_orders), coefficients of their power series.
    """

    parameters: Sequence[float]
    start: Sequence[float]
    inputs: Sequence[Sequence[float]]


class Equations:
    """A model's equations as they are followed with power series."""

    def __init__(self, model: ProcessModel) -> None:
        self.model = model
        self._derivative = followed(model.derivative)
        self._output = followed(model.output) if model.output is not None else None

    def trace(self, tape: Tape) -> list[str]:
        """Names on the tape of dx/dt, and behind them of the outputs; raises ModelError."""
        model = self.model
        x, u, p = (
            traces(tape, letter, len(items))
            for letter, items in zip(
                "xup", (model.states, model.inputs, model.parameters), strict=True
            )
        )
        try:
            values = list(map(operand, self._derivative(x, u, p)))
            if self._output is not None:
                return values + list(map(operand, self._output(x, u, p)))
        except (ArithmeticError, ModelError):
            raise
        except Exception as error:
            raise self._untraceable(error) from error
        return values + [f"x{i}" for i in model.output_states or ()]

    def sensitivities(
        self, point: ExpansionPoint, free: Sequence[int], starts: Sequence[int], order: int
    ) -> list[list[arb]]:
        """Derivatives of the outputs' coefficients by free parameters and starts.

        free, starts: places of the parameters and states. Rows run over outputs within orders,
        (order * n_outputs, n_free + n_starts). Raises ArithmeticError where the equations have no
        power series, and ModelError where they cannot be followed.
        """
        n = len(self.model.states)
        tape, names = self._solve(point, order)
        n_parameters = len(self.model.parameters)
        zeros: dict[str, dict[int, str]] = {f"x{i}": {i: "1.0"} for i in range(n)}
        zeros |= {f"p{j}": {n + k: "1.0"} for k, j in enumerate(free) if j < n_parameters}
        try:
            slopes = differentiate(tape, names, zeros)
            table = {place: coefficients(tape.value(name)) for place, name in slopes.items()}
        except TypeError as error:
            raise self._untraceable(error) from error
        return _variations(table, n, len(names), len(free), starts, order)

    def _solve(self, point: ExpansionPoint, order: int) -> tuple[Tape, list[str]]:
        """The tape at the solution, its numbers being power series of so many orders."""
        states = [[arb(value)] for value in point.start]
        outcomes: dict[str, bool] = {}
        settled = 0
        for turn in range(1, _PATIENCE * order + 1):
            ctx.cap = min(turn, order)
            values: dict[str, Any] = {f"p{j}": arb(v) for j, v in enumerate(point.parameters)}
            values |= {f"u{j}": arb_series(list(map(arb, c))) for j, c in enumerate(point.inputs)}
            values |= {f"x{i}": arb_series(c) for i, c in enumerate(states)}
            tape = Tape(values, series_operation)
            names = self.trace(tape)
            settled = settled + 1 if tape.decisions == outcomes else 1
            if settled > order:
                return tape, names
            outcomes = dict(tape.decisions)
            for i, start in enumerate(point.start):
                rate = coefficients(tape.value(names[i]))
                states[i] = [arb(start), *(c / (k + 1) for k, c in enumerate(rate))]
        raise ArithmeticError("conditions do not settle")

    def _untraceable(self, error: Exception) -> ModelError:
        return ModelError(
            f"model {self.model.name}: its equations cannot be followed step by step "
            f"({type(error).__name__}: {error}); write them with arithmetic, if, abs, min, max and "
            "functions of math on single numbers, without tables, int() or float()"
        )


def _variations(
    slopes: dict[tuple[int, int], list[arb]],
    n_states: int,
    n_rows: int,
    n_free: int,
    starts: Sequence[int],
    order: int,
) -> list[list[arb]]:
    """Sensitivities of the outputs' coefficients from the series of all partial derivatives.

    slopes: by row (states' rates, then outputs) and column (states, then parameters).
    """
    n_columns = n_free + len(starts)
    none = arb(0)

    def entry(i: int, k: int, power: int) -> arb:
        series = slopes.get((i, k))
        return none if series is None else series[power]

    # By power: rows by states, as one block after another from the latest power back.
    by_state = [
        [[entry(i, k, power) for k in range(n_states)] for i in range(n_rows)]
        for power in range(order)
    ]
    first = [[none] * n_columns for _ in range(n_states)]
    for column, state in enumerate(starts):
        first[state][n_free + column] = arb(1)
    stacked = first
    rows: list[list[arb]] = []
    for power in range(order):
        blocks = [[e for m in range(power, -1, -1) for e in by_state[m][i]] for i in range(n_rows)]
        moved = (arb_mat(blocks) * arb_mat(stacked)).tolist()
        for i, row in enumerate(moved):
            for j in range(n_free):
                row[j] += entry(i, n_states + j, power)
        stacked = stacked + [[e / (power + 1) for e in row] for row in moved[:n_states]]
        rows += moved[n_states:]
    return rows
