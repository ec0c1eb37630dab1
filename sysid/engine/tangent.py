"""A model's equations together with a tangent: how states and outputs move with the parameters.

Along a direction p' of the parameters and x0' of the start the solution of x' = f(x, u, p) moves by

    s' = f_x s + f_p p'        s(0) = x0'        y' = g_x s + g_p p'

The scheme takes f apart into A x + N(x, u, p), with A fixed by the parameters. The tangent is
taken apart by the derivative of that:

    s' = (A s + A' x) + (N_x s + N_p p')

so that x and s, integrated together by the same steps, obey the derivative of every line of the
scheme: to rounding s is the derivative of the simulated states, however coarse the steps are. What
the outputs do not show at all comes out as zero, and not as the integration's error.
"""

from collections.abc import Mapping, Sequence

from sysid.engine.batch_kernel import BatchKernel
from sysid.engine.gradient import Tangent, differentiate
from sysid.engine.program import Writer
from sysid.engine.split import Splitter
from sysid.engine.structure import Structure, analyse, parts, split_function
from sysid.engine.tape import Tape
from sysid.engine.variation import not_differentiable
from sysid.problem.model import ProcessModel


class TangentKernel(BatchKernel):
    """Text of the kernel of tangents: the batch kernel's ``simulate`` of x, and of s behind it.

    ``start`` and ``p`` hold those of the model, and behind them x0' and p'; the outputs are y'.
    Steps are chosen elsewhere, so that no errors are estimated.
    """

    def __init__(self, model: ProcessModel) -> None:
        super().__init__(model, _structure(model))

    def text(self, *, many_registers: bool) -> str:
        """Python text of ``simulate``."""
        return self._simulate(many_registers)

    def _estimate(self) -> list[str]:
        return []


def _structure(model: ProcessModel) -> Structure:
    """Structure of the equations and their tangent; ModelError where there is none."""
    try:
        return _with_tangent(model, analyse(model))
    except Exception as error:
        # Whatever a function may do that traces cannot follow.
        raise not_differentiable(model, error) from error


def _with_tangent(model: ProcessModel, plain: Structure) -> Structure:
    """The same, of equations whose own structure is ``plain``."""
    splitter, n, n_parameters = Splitter(), len(model.states), len(model.parameters)
    tape = splitter.tape
    moves = {**_moves("x", n), **_moves("p", n_parameters)}
    rows = split_function(splitter, model, model.derivative, branches=True)
    exact = "derivative" not in plain.calls
    pieces = [parts(splitter, row) if exact else ({}, row.total) for row in rows]
    linear = {(i, j): name for i, (row, _) in enumerate(pieces) for j, name in row.items()}
    changes = dict(zip(linear, _tangents(tape, list(linear.values()), moves), strict=True))
    coefficients = {
        **linear,
        **{(n + i, n + j): name for (i, j), name in linear.items()},
        **{(n + i, j): name for (i, j), name in changes.items() if name != _NONE},
    }
    rests = [rest for _, rest in pieces]
    functions = {"remainder": [*rests, *_tangents(tape, rests, moves)]}
    states = None
    if model.output_states is not None:
        states = tuple(n + i for i in model.output_states)
    if model.output is not None:
        values = split_function(splitter, model, model.output, branches=True)
        functions["observe"] = _tangents(tape, [value.total for value in values], moves)
    writer = Writer(tape, 2 * n_parameters, functions, coefficients.values())
    driven = (*plain.driven, *(n + i for i in plain.driven))
    return Structure(
        2 * n, len(model.inputs), 2 * n_parameters, len(model.outputs), states,
        writer.placed(coefficients), driven, plain.nonlinear, (), frozenset(), writer.program(),
        len(writer.constants), writer.calls,
    )  # fmt: skip


_NONE = "0.0"  # tangent of what does not move


def _moves(letter: str, count: int) -> dict[str, Tangent]:
    """How states or parameters move: by what stands behind them."""
    return {f"{letter}{i}": {0: f"{letter}{count + i}"} for i in range(count)}


def _tangents(tape: Tape, names: Sequence[str], moves: Mapping[str, Tangent]) -> list[str]:
    """Tangents of named numbers."""
    slopes = differentiate(tape, names, moves)
    return [slopes.get((i, 0), _NONE) for i in range(len(names))]
