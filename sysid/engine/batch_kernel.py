"""Source text of the batch kernels: lanes of chromosomes over a record.

Chromosomes are the innermost lanes: the work area is one-dimensional and indexed
``i*L + lane`` with L a literal, and one whole integration step stands in the lane loop, so that
LLVM turns each line into vector instructions. Two-dimensional arrays or an inner loop over
stages give scalar code, about five times slower (docs/decisions/0003-batch-kernel.md).
"""

import re
from collections.abc import Sequence

from sysid.engine.lanes import LANES
from sysid.engine.program import block, listed
from sysid.engine.scheme import (
    Place,
    Shape,
    call,
    effects,
    error_of_n,
    fill,
    margins,
    missed,
    numbered,
    slope,
    stage_inputs,
    step,
    step_sizes,
)

_STAGES = {"a": "0.0", "b": "0.5", "c": "1.0"}  # and how much of a step has passed
# ||J^16||^(1/16) is an upper bound of the spectral radius that is tight to a few per cent.
_SQUARINGS = 4


def source(shape: Shape, *, many_registers: bool) -> str:
    """Python text of the kernels; needs math, np, scheme_matrices, wide_vectors and the program.

    ``simulate`` runs lanes of chromosomes over a record, ``spectrum`` bounds the fastest rate
    of what is not integrated exactly.
    """
    # Plain Runge-Kutta keeps so much at hand that two lanes at once need room for it.
    paired = many_registers or bool(shape.structure.coefficients)
    return "\n\n".join((_simulate(shape, paired), _spectrum(shape), ""))


def work_rows(s: Shape) -> int:
    """Rows of lanes in the work area of one block."""
    return first_entry(s) + s.n_entries


def first_entry(s: Shape) -> int:
    """Row of the first entry of the matrices."""
    return _Rows(s).matrices


class _Rows:
    """Where in the work area states, constants, error sums and matrices begin."""

    def __init__(self, s: Shape) -> None:
        self.constants = s.n_states
        self.sums = self.constants + s.n_constants
        self.estimates = self.sums + s.n_outputs
        self.matrices = self.estimates + s.n_outputs


def _at(row: int) -> str:
    """Lane l in a row of the work area."""
    return f"X[{row * LANES} + l]"


def _constants(s: Shape) -> str:
    first = _Rows(s).constants
    return "c = " + listed(_at(first + i) for i in range(s.n_constants))


def _simulate(s: Shape, paired: bool) -> str:
    q, rows = s.n_outputs, _Rows(s)
    each_lane = f"for l in range({LANES}):"
    errors = [f"record[k, {j}, l] = (o{j} - y{j}) * w{j}" for j in range(q)]
    total = " + ".join(_at(rows.sums + j) for j in range(q))
    sample = [
        *[f"v{j} = u[k, {j}]" for j in range(s.n_inputs)],
        *[f"{name}{j} = {name}[k, {j}]" for name in "yw" for j in range(q)],
        *block(each_lane, _residuals(s)),
        *block("if record.shape[0] > 0:", block(each_lane, _outputs(s), errors)),
        *block("if k == n_samples - 1:", ["break"]),
        # A block in which all chromosomes have blown up has nothing more to say.
        *block(
            "if k % 64 == 63:",
            ["alive = False"],
            block(each_lane, [f"total = {total}", "alive = alive or math.isfinite(total)"]),
            block("if not alive:", ["break"]),
        ),
        *_input_slopes(s),
        *block("for step in range(n_steps):", _stage_inputs(s), _all_lanes(s, paired)),
    ]
    sums = f"sums[j, l] = X[({rows.sums} + j) * {LANES} + l]"
    body = [
        "wide_vectors()",
        "n_samples = u.shape[0]",
        "h = dt / n_steps",
        *step_sizes(),
        *_begin(s),
        *block("for k in range(n_samples):", sample),
        *block(f"for j in range({2 * q}):", block(each_lane, [sums])),
    ]
    head = "def simulate(X, rows, tables, u, y, w, start, p, dt, n_steps, sums, record):"
    return "\n".join(block(head, body))


def _begin(s: Shape) -> list[str]:
    """All lanes before the first sample."""
    rows = _Rows(s)
    closure = s.structure.closure(s.n_states)
    p = listed(f"p[{i}, l]" for i in range(s.n_parameters))
    lane = [
        f"c = constants({p})",
        *[f"{_at(rows.constants + i)} = c[{i}]" for i in range(s.n_constants)],
        *[f"{_at(i)} = start[{i}, l]" for i in range(s.n_states)],
        *[f"{_at(rows.sums + j)} = 0.0" for j in range(2 * s.n_outputs)],
        *fill(s),
    ]
    lines = [
        f"A = np.zeros(({len(closure)}, {LANES}))",
        *block(f"for l in range({LANES}):", lane),
    ]
    if s.n_entries:
        lines.append(f"scheme_matrices(A, np.full({LANES}, h), *tables, rows)")
    return lines


def _residuals(s: Shape) -> list[str]:
    lines = _outputs(s)
    for j in range(s.n_outputs):
        lines.append(f"e = (o{j} - y{j}) * w{j}")
        lines.append(f"{_at(_Rows(s).sums + j)} += e * e")
    return lines


def _lane_step(s: Shape) -> list[str]:
    """One step of lane l and its error estimate, as scalars."""
    first = _Rows(s).matrices

    def place(entry: int) -> str:
        return _at(first + entry)

    return [
        *[f"x{i} = {_at(i)}" for i in range(s.n_states)],
        _constants(s),
        *slope(s, "x", "ua", "m", "k"),
        *step(s, place),
        *[f"{_at(i)} = n{i}" for i in range(s.n_states)],
        *_estimate(s, place),
    ]


def _all_lanes(s: Shape, paired: bool) -> list[str]:
    """One step of all lanes."""
    lines = _lane_step(s)
    if paired:
        return block(f"for l in range({LANES // 2}):", _paired(lines))
    return block(f"for l in range({LANES}):", lines)


def _paired(lines: list[str]) -> list[str]:
    """Each line for lane l and for the lane half a block on.

    A step is one long chain of operations that wait for each other; a second chain beside it
    fills the waits, which the processor does not look far enough ahead to do by itself.
    """
    assigned = {
        name.strip()
        for line in lines
        for name in line.partition(" = ")[0].split(",")
        if name.strip().isidentifier()
    }
    second = f"+ l + {LANES // 2}]"

    def moved(line: str) -> str:
        renamed = re.sub(r"\w+", lambda m: m[0] + "_" * (m[0] in assigned), line)
        return renamed.replace("+ l]", second)

    return [twin for line in lines for twin in (line, moved(line))]


def _estimate(s: Shape, place: Place) -> list[str]:
    """Add the step's error estimate, as it shows in the outputs, to the lane's sums."""
    lines = error_of_n(s) + _shown(s, effects(s, "t", s.structure.driven, place))
    if s.structure.guards:
        lines += slope(s, "n", "uc", "mn", "kn")
        lines += [*margins(s, "x", "ua", "q"), *margins(s, "n", "uc", "r"), *missed(s)]
        lines += _shown(s, effects(s, "f", s.guarded, place))
    return lines


def _shown(s: Shape, errors: Sequence[str]) -> list[str]:
    """Add to the lane's sums what errors of the states do to the outputs."""
    lines: list[str] = []
    shown: list[str] = []
    if s.output_states is not None:
        shown = [errors[i] for i in s.output_states]
    elif any(errors):
        u, n = numbered("uc", s.n_inputs), numbered("n", s.n_states)
        exact = [f"n{i} - ({error})" if error else f"n{i}" for i, error in enumerate(errors)]
        lines += call("observe", "o", s.n_outputs, n, u)
        lines += call("observe", "p", s.n_outputs, exact, u)
        shown = [f"o{j} - p{j}" for j in range(s.n_outputs)]
    for j, error in enumerate(shown):
        if error:
            lines.append(f"e = {error}")
            lines.append(f"{_at(_Rows(s).estimates + j)} += e * e")
    return lines


def _input_slopes(s: Shape) -> list[str]:
    """Change per step of the interpolated inputs in the interval from sample k."""
    lines = [f"i{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j, foh in enumerate(s.foh) if foh]
    # Behind the inputs stand what squares and cubes count for in the splines (``bends``).
    for place, j in enumerate(j for j, spline in enumerate(s.spline) if spline):
        column = s.n_inputs + 2 * place
        lines += [f"square{j} = u[k, {column}]", f"cube{j} = u[k, {column + 1}]"]
    return lines


def _stage_inputs(s: Shape) -> list[str]:
    """Inputs at the start (a), middle (b) and end (c) of a step."""
    lines = stage_inputs(s, "step")
    if any(s.spline):
        lines += [f"r{stage} = (step + {part}) / n_steps" for stage, part in _STAGES.items()]
    for j in (j for j, spline in enumerate(s.spline) if spline):
        for stage in _STAGES:
            away = f"r{stage} * (r{stage} - 1.0)"
            lines.append(f"u{stage}{j} += {away} * (square{j} + cube{j} * (r{stage} + 1.0))")
    return lines


def _outputs(s: Shape) -> list[str]:
    """Lines that set the outputs o from lane l's state."""
    if s.output_states is not None:
        return [f"o{j} = {_at(i)}" for j, i in enumerate(s.output_states)]
    x, u = [_at(i) for i in range(s.n_states)], numbered("v", s.n_inputs)
    return [_constants(s), *call("observe", "o", s.n_outputs, x, u)]


def _spectrum(s: Shape) -> str:
    """Bound on the fastest rate of N, also beyond limits that no output would show.

    Only the driven rows of its Jacobian are not zero, so that its eigenvalues are those of the
    block of driven rows and columns.
    """
    rows = s.structure.driven
    head = "def spectrum(u, x, p, rate):"
    if not rows:
        return "\n".join(block(head, ["pass"]))
    finite = " and ".join(f"math.isfinite(X[{i}])" for i in range(s.n_states))
    at_sample = [
        *[f"X[{i}] = x[k, {i}, l]" for i in range(s.n_states)],
        *block(f"if not ({finite}):", ["continue"]),
        *_jacobian(s),
        *_radius(),
    ]
    lane = [
        f"c = constants({listed(f'p[{i}, l]' for i in range(s.n_parameters))})",
        *[f"rate[l] = max(rate[l], abs({text}))" for text in _hidden_limits(s)],
        *block("for k in range(u.shape[0]):", at_sample),
    ]
    body = [
        # Not a literal: the compiler would unroll the matrix products for seconds.
        f"n = min(x.shape[1], {len(rows)})",
        "J = np.empty((n, n))",
        "T = np.empty((n, n))",
        f"X = np.empty({s.n_states})",
        f"N = np.empty({len(rows)})",
        *block("for l in range(rate.shape[0]):", lane),
    ]
    return "\n".join(block(head, body))


def _hidden_limits(s: Shape) -> list[str]:
    """What a limited state's straight piece makes of itself in its own row.

    Beyond a limit N takes the straight piece back, as fast as A has it. Where an output shows
    the state the error estimate sees that; an error in a hidden one only adds up.
    """
    return [
        f"({gain}) * ({guard.slopes[row]})"
        for guard in s.structure.guards
        for row, gain in guard.gains.items()
        if row in guard.slopes and row not in s.structure.shown
    ]


def _jacobian(s: Shape) -> list[str]:
    """J of the driven rows and columns of N beside X, by differences.

    Beside, because what switches most often does so where a model starts: dry friction at rest.
    A difference across the switch would be taken for an endlessly fast rate. And by more than
    the differences: the flow through an orifice is endlessly steep at rest, but only there.
    """
    rows = s.structure.driven
    x = [f"X[{i}]" for i in range(s.n_states)]
    u = [f"u[k, {j}]" for j in range(s.n_inputs)]
    beside = [
        *[f"q = {row} if j == {j} else q" for j, row in enumerate(rows)],
        "kept = X[q]",
        "d = 1e-7 * max(abs(kept), 1e-2)",
        "X[q] = kept + d",
    ]
    difference = [f"J[{i}, j] = (a{row} - N[{i}]) / d" for i, row in enumerate(rows)]
    return [
        *[f"X[{i}] += 1e-5 * max(abs(X[{i}]), 1e-2)" for i in rows],
        # Round -1 evaluates at the point itself; a single call site keeps compilation short.
        *block(
            f"for j in range(-1, {len(rows)}):",
            ["d = 0.0", "q = 0", "kept = X[0]"],
            block("if j >= 0:", beside),
            call("remainder", "a", s.n_states, x, u),
            block("if j < 0:", [f"N[{i}] = a{row}" for i, row in enumerate(rows)]),
            block("else:", ["X[q] = kept"], difference),
        ),
    ]


def _radius() -> list[str]:
    """Raise lane l's rate to a bound on the spectral radius of J, by repeated squaring."""
    return f"""\
exponent = 0.0
for squaring in range({_SQUARINGS + 1}):
    norm = 0.0
    for i in range(n):
        for j in range(n):
            norm += J[i, j] * J[i, j]
    norm = math.sqrt(norm)
    if norm == 0.0:
        exponent = -math.inf
        break
    if not math.isfinite(norm):
        exponent = math.inf
        break
    exponent += math.log(norm) / 2.0 ** squaring
    if squaring == {_SQUARINGS}:
        break
    for i in range(n):
        for j in range(n):
            J[i, j] /= norm
    for i in range(n):
        for j in range(n):
            t = 0.0
            for q in range(n):
                t += J[i, q] * J[q, j]
            T[i, j] = t
    for i in range(n):
        for j in range(n):
            J[i, j] = T[i, j]
rate[l] = max(rate[l], math.exp(exponent))""".splitlines()
