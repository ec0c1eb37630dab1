"""Source text of the kernels that advance one trajectory, with steps halved where it is needed.

Every sample interval is a number of equal base steps. A base step is taken whole, or in parts of
2^-level of it where the error estimate is too large; each level's matrices are stored once. A
level that was found is kept until a coarser one fits again, and forgotten at the end of the
interval: what happens in one depends on nothing but the state it starts from.

``least`` is the level that no step is coarser than: a swing of several periods within a step may
look the same at both its ends and in its middle, and run into limits in between.
"""

from __future__ import annotations

from sysid.engine.lanes import LANES
from sysid.engine.program import listed
from sysid.engine.scheme import (
    Place,
    Shape,
    call,
    error_of_n,
    fill,
    margins,
    missed,
    numbered,
    product,
    slope,
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
    lines = [
        "def levels(X, tables, p, scale, h, a):",
        f"    c = constants({listed(f'p[{i}]' for i in range(s.n_parameters))})",
        *[f"    X[{i}] = c[{i}]" for i in range(s.n_constants)],
        f"    for i in range({s.n_states}):",
        f"        X[{s.n_constants} + i] = 1.0 / scale[i]",
        *[f"    a[{i}, {j}] = {text}" for (i, j), text in s.structure.coefficients.items()],
    ]
    if s.n_entries:
        lines += [
            f"    A = np.zeros(({len(closure)}, {LANES}))",
            f"    H = np.zeros({LANES})",
            f"    rows = np.empty(({s.n_entries}, {LANES}))",
            f"    for l in range({LEVELS + 1}):",
            "        H[l] = h * 0.5 ** l",
            *[f"        {line}" for line in fill(s)],
            "    scheme_matrices(A, H, *tables, rows)",
            f"    for l in range({LEVELS + 1}):",
            f"        for k in range({s.n_entries}):",
            f"            X[{_first_entry(s)} + l * {s.n_entries} + k] = rows[k, l]",
        ]
    return "\n".join(lines)


def _advance(s: Shape) -> str:
    n, whole = s.n_states, 2**LEVELS
    lines = [
        "def advance(X, u, x, base, n_steps, least, limit, trace, outputs):",
        f"    c = {listed(f'X[{i}]' for i in range(s.n_constants))}",
        *[f"    z{i} = X[{s.n_constants + i}]" for i in range(n)],
        *[f"    x{i} = x[{i}]" for i in range(n)],
        "    for k in range(u.shape[0] - 1):",
        *[f"        v{j} = u[k, {j}]" for j in range(s.n_inputs)],
        *[f"        {line}" for line in _outputs(s)],
        *[f"        i{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j, foh in enumerate(s.foh) if foh],
        *[f"        {line}" for line in slope(s, "x", "v", "m", "k")],
        *[f"        {line}" for line in margins(s, "x", "v", "q")],
        "        level = least",
        "        for step in range(n_steps):",
        *[f"            trace[k * n_steps + step, {i}] = x{i}" for i in range(n)],
        # What is not finite any more gets no better by halving.
        f"            finite = math.isfinite({' + '.join(numbered('k', n))})",
        f"            deepest = {LEVELS} if finite else least",
        "            level = min(level, deepest)",
        "            done = 0",
        f"            while done < {whole}:",
        *[f"                {line}" for line in _part(s)],
        *[f"    x[{i}] = x{i}" for i in range(n)],
    ]
    return "\n".join(lines)


def _part(s: Shape) -> list[str]:
    """Try one part of a base step; take it where its error allows, or halve it."""
    whole = 2**LEVELS

    def place(entry: int) -> str:
        return f"X[first + {entry}]"

    return [
        f"part = {whole} >> level",
        f"share = part * {1.0 / whole!r}",
        "h = base * share",
        f"first = {_first_entry(s)} + level * {s.n_entries}",
        *step_sizes(),
        *_stage_inputs(s),
        *step(s, place),
        *slope(s, "n", "uc", "mn", "kn"),
        *margins(s, "n", "uc", "r"),
        *_error(s, place),
        "if error <= limit or level == deepest:",
        *[f"    x{i} = n{i}" for i in range(s.n_states)],
        *[f"    m{i} = mn{i}" for i in range(s.n_states)],
        *[f"    k{i} = kn{i}" for i in range(s.n_states)],
        *[f"    q{i} = r{i}" for i in range(s.n_margins)],
        "    done += part",
        f"    if level > least and error <= {_COARSER!r} * limit and done % (2 * part) == 0:",
        "        level -= 1",
        "else:",
        "    level += 1",
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
    for vector, known in (("t", driven), ("o", driven), ("f", s.guarded)):
        for i in range(s.n_states):
            if term := product(s, "G", i, vector, place, known=known).removeprefix(" + "):
                name = f"e{vector}{i}"
                lines.append(f"{name} = ({term}) * z{i}")
                squares.append(f"{name} * {name}")
    return [*lines, f"error = {' + '.join(squares) or '0.0'}"]


def _stage_inputs(s: Shape) -> list[str]:
    """Inputs at the start (a), middle (b) and end (c) of a part."""
    lines = []
    for j, foh in enumerate(s.foh):
        if foh:
            lines.append(f"ua{j} = v{j} + i{j} * (step + done * {2.0**-LEVELS!r})")
            lines.append(f"ub{j} = ua{j} + 0.5 * share * i{j}")
            lines.append(f"uc{j} = ua{j} + share * i{j}")
        else:
            lines += [f"u{stage}{j} = v{j}" for stage in "abc"]
    return lines


def _outputs(s: Shape) -> list[str]:
    """Lines that store the outputs at the start of interval k."""
    if s.output_states is not None:
        return [f"outputs[k, {j}] = x{i}" for j, i in enumerate(s.output_states)]
    lines = call("observe", "o", s.n_outputs, numbered("x", s.n_states), numbered("v", s.n_inputs))
    return lines + [f"outputs[k, {j}] = o{j}" for j in range(s.n_outputs)]
