"""Source text of the kernels that advance one trajectory, with steps halved where it is needed.

Every sample interval is a number of equal base steps. A base step is taken whole, or in parts of
2^-level of it where the error estimate is too large; each level's matrices are stored once. A
level that was found is kept until a coarser one fits again, and forgotten at the end of the
interval: what happens in one depends on nothing but the state it starts from.

``least`` is the level that no step is coarser than: a swing of several periods within a step may
look the same at both its ends and in its middle, and run into limits in between.
"""

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

LEVELS = 10

# The squared estimate falls with the sixth power of the step; half of what is allowed is left
# as a margin, so that a coarser step is seldom tried in vain.
_COARSER = 2.0**-7


def source(shape: Shape) -> str:
    """Python text of the kernels; needs math, np, scheme_matrices and the program.

    ``levels`` fills a work area once per parameter vector, ``advance`` uses it.
    """
    return "\n\n".join((_levels(shape), _advance(shape), ""))


def work_size(s: Shape) -> int:
    """Floats in the work area: constants, inverse magnitudes, each level's matrices."""
    return _first_entry(s) + (LEVELS + 1) * s.n_entries


def _first_entry(s: Shape) -> int:
    return s.n_constants + s.n_states


def _levels(s: Shape) -> str:
    """Fill the work area, and A; each level is a lane while its matrices are made."""
    closure = s.structure.closure(s.n_states)
    body = [
        f"c = constants({listed(f'p[{i}]' for i in range(s.n_parameters))})",
        *[f"X[{i}] = c[{i}]" for i in range(s.n_constants)],
        *block(f"for i in range({s.n_states}):", [f"X[{s.n_constants} + i] = 1.0 / scale[i]"]),
        *[f"a[{i}, {j}] = {text}" for (i, j), text in s.structure.coefficients.items()],
    ]
    if s.n_entries:
        each = f"for l in range({LEVELS + 1}):"
        stored = f"X[{_first_entry(s)} + l * {s.n_entries} + k] = rows[k, l]"
        body += [
            f"A = np.zeros(({len(closure)}, {LANES}))",
            f"H = np.zeros({LANES})",
            f"rows = np.empty(({s.n_entries}, {LANES}))",
            *block(each, ["H[l] = h * 0.5 ** l"], fill(s)),
            "scheme_matrices(A, H, *tables, rows)",
            *block(each, block(f"for k in range({s.n_entries}):", [stored])),
        ]
    return "\n".join(block("def levels(X, tables, p, scale, h, a):", body))


def _advance(s: Shape) -> str:
    n, whole = s.n_states, 2**LEVELS
    base_step = [
        *[f"trace[k * n_steps + step, {i}] = x{i}" for i in range(n)],
        # What is not finite any more gets no better by halving.
        f"finite = math.isfinite({' + '.join(numbered('k', n))})",
        f"deepest = {LEVELS} if finite else least",
        "level = min(level, deepest)",
        "done = 0",
        *block(f"while done < {whole}:", _part(s)),
    ]
    interval = [
        *[f"v{j} = u[k, {j}]" for j in range(s.n_inputs)],
        *_outputs(s),
        *[f"i{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j, foh in enumerate(s.foh) if foh],
        *slope(s, "x", "v", "m", "k"),
        *margins(s, "x", "v", "q"),
        "level = least",
        *block("for step in range(n_steps):", base_step),
    ]
    body = [
        f"c = {listed(f'X[{i}]' for i in range(s.n_constants))}",
        *[f"z{i} = X[{s.n_constants + i}]" for i in range(n)],
        *[f"x{i} = x[{i}]" for i in range(n)],
        *block("for k in range(u.shape[0] - 1):", interval),
        *[f"x[{i}] = x{i}" for i in range(n)],
    ]
    head = "def advance(X, u, x, base, n_steps, least, limit, trace, outputs):"
    return "\n".join(block(head, body))


def _part(s: Shape) -> list[str]:
    """Try one part of a base step; take it where its error allows, or halve it."""
    whole = 2**LEVELS

    def place(entry: int) -> str:
        return f"X[first + {entry}]"

    kept = (("x", "n", s.n_states), ("m", "mn", s.n_states), ("k", "kn", s.n_states))
    taken = [
        *[
            f"{now}{i} = {new}{i}"
            for now, new, n in (*kept, ("q", "r", s.n_margins))
            for i in range(n)
        ],
        "done += part",
        *block(
            f"if level > least and error <= {_COARSER!r} * limit and done % (2 * part) == 0:",
            ["level -= 1"],
        ),
    ]
    return [
        f"part = {whole} >> level",
        f"share = part * {1.0 / whole!r}",
        "h = base * share",
        f"first = {_first_entry(s)} + level * {s.n_entries}",
        *step_sizes(),
        *stage_inputs(s, f"(step + done * {1.0 / whole!r})", "share * "),
        *step(s, place),
        *slope(s, "n", "uc", "mn", "kn"),
        *margins(s, "n", "uc", "r"),
        *_error(s, place),
        *block("if error <= limit or level == deepest:", taken),
        *block("else:", ["level += 1"]),
    ]


def _error(s: Shape, place: Place) -> list[str]:
    """Sum of squares, over the states, of all that hints at an error of a step."""
    driven = s.structure.driven
    lines = error_of_n(s)
    # A relay that the first half of a step overshoots sends the stages to and fro, and cancels
    # from the estimate; the two stages at the middle of the step then differ.
    lines += [f"o{i} = db{i} - da{i}" for i in driven]
    lines += missed(s)
    squares = []
    for vector, rows in (("t", driven), ("o", driven), ("f", s.guarded)):
        for i, effect in enumerate(effects(s, vector, rows, place)):
            if effect:
                lines.append(f"e{vector}{i} = ({effect}) * z{i}")
                squares.append(f"e{vector}{i} * e{vector}{i}")
    return [*lines, f"error = {' + '.join(squares) or '0.0'}"]


def _outputs(s: Shape) -> list[str]:
    """Lines that store the outputs at the start of interval k."""
    if s.output_states is not None:
        return [f"outputs[k, {j}] = x{i}" for j, i in enumerate(s.output_states)]
    lines = call("observe", "o", s.n_outputs, numbered("x", s.n_states), numbered("v", s.n_inputs))
    return lines + [f"outputs[k, {j}] = o{j}" for j in range(s.n_outputs)]
