"""Source text of the batch kernels, made for one model's shape.

Chromosomes are the innermost lanes: work arrays are one-dimensional and indexed ``i*L + lane``
with L a literal, and one whole Runge-Kutta step stands in the lane loop, so that LLVM turns
each line into vector instructions. Two-dimensional arrays or an inner loop over stages give
scalar code, about five times slower (docs/decisions/0003-batch-kernel.md).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sysid.model import ProcessModel

LANES = 16

# ||J^16||^(1/16) is an upper bound of the spectral radius that is tight to a few per cent.
_SQUARINGS = 4


@dataclass(frozen=True)
class Shape:
    """All that the kernel's text depends on."""

    n_states: int
    n_inputs: int
    n_outputs: int
    n_parameters: int
    foh: tuple[bool, ...]
    output_states: tuple[int, ...] | None

    @classmethod
    def of(cls, model: ProcessModel) -> Shape:
        return cls(
            len(model.states),
            len(model.inputs),
            len(model.outputs),
            len(model.parameters),
            tuple(signal.hold == "foh" for signal in model.inputs),
            model.output_states,
        )


def work_size(shape: Shape) -> int:
    """Floats in the work area: states, parameters and error sums of every lane."""
    return (shape.n_states + shape.n_parameters + shape.n_outputs) * LANES


def source(shape: Shape) -> str:
    """Python text of the kernels; needs np, math, derivative and output as globals.

    ``simulate`` runs lanes of chromosomes over a record, ``spectrum`` bounds the fastest rate
    of the model at given points, ``advance`` runs one trajectory and keeps every step of it.
    ``simulate`` works in X, (work_size,) floats that start on a cache line.
    """
    return "\n\n".join((_simulate(shape), _spectrum(shape), _advance(shape), ""))


def _simulate(s: Shape) -> str:
    n, m, q, r = s.n_states, s.n_inputs, s.n_outputs, s.n_parameters
    lanes = LANES
    lines = [
        "def simulate(X, u, y, w, x0, p, dt, n_steps, sse, record, every, snapshots):",
        f"    for i in range({(n + r) * lanes}, {(n + r + q) * lanes}):",
        "        X[i] = 0.0",
        f"    for i in range({n}):",
        f"        for l in range({lanes}):",
        f"            X[i * {lanes} + l] = x0[i, l]",
        f"    for i in range({r}):",
        f"        for l in range({lanes}):",
        f"            X[({n} + i) * {lanes} + l] = p[i, l]",
        "    n_samples = u.shape[0]",
        "    store = record.shape[0] > 0",
        "    h = dt / n_steps",
        "    h2 = 0.5 * h",
        "    h6 = h / 6.0",
        "    for k in range(n_samples):",
    ]
    add = lines.append
    for j in range(m):
        add(f"        v{j} = u[k, {j}]")
    for j in range(q):
        add(f"        y{j} = y[k, {j}]")
        add(f"        w{j} = w[k, {j}]")
    # Lane l of state i is X[i*L + l]; the parameters follow the states.
    outputs = _outputs(s, f"X[{{}} * {lanes} + l]", f"X[({n} + {{}}) * {lanes} + l]")
    add(f"        for l in range({lanes}):")
    lines += [" " * 12 + line for line in outputs]
    for j in range(q):
        add(f"            e = (o{j} - y{j}) * w{j}")
        add(f"            X[{(n + r + j) * lanes} + l] += e * e")
    add("        if store:")
    add(f"            for l in range({lanes}):")
    lines += [" " * 16 + line for line in outputs]
    for j in range(q):
        add(f"                record[k, {j}, l] = o{j}")
    add("        if every > 0 and k % every == 0 and k // every < snapshots.shape[0]:")
    add(f"            for i in range({n}):")
    add(f"                for l in range({lanes}):")
    add(f"                    snapshots[k // every, i, l] = X[i * {lanes} + l]")
    add("        if k == n_samples - 1:")
    add("            break")
    # A block in which every chromosome has blown up has nothing more to say.
    add("        if k % 64 == 63:")
    add("            alive = False")
    add(f"            for l in range({lanes}):")
    total = " + ".join(f"X[{(n + r + j) * lanes} + l]" for j in range(q))
    add(f"                alive = alive or math.isfinite({total})")
    add("            if not alive:")
    add("                break")
    lines += [" " * 8 + line for line in _slopes(s)]
    add("        for step in range(n_steps):")
    lines += [" " * 12 + line for line in _stage_inputs(s)]
    add(f"            for l in range({lanes}):")
    for i in range(n):
        add(f"                x{i} = X[{i * lanes} + l]")
    add(f"                pp = {_tuple(f'X[{(n + i) * lanes} + l]' for i in range(r))}")
    lines += [" " * 16 + line for line in _runge_kutta(s)]
    for i in range(n):
        add(f"                X[{i * lanes} + l] = n{i}")
    add(f"    for j in range({q}):")
    add(f"        for l in range({lanes}):")
    add(f"            sse[j, l] = X[({n + r} + j) * {lanes} + l]")
    return "\n".join(lines)


def _slopes(s: Shape) -> list[str]:
    """Change per step of the interpolated inputs in the interval from sample k."""
    return [f"s{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j, foh in enumerate(s.foh) if foh]


def _stage_inputs(s: Shape) -> list[str]:
    """Inputs at the start (a), middle (b) and end (c) of a step."""
    lines = []
    for j, foh in enumerate(s.foh):
        if foh:
            lines += [
                f"a{j} = v{j} + s{j} * step",
                f"b{j} = a{j} + 0.5 * s{j}",
                f"c{j} = a{j} + s{j}",
            ]
        else:
            lines += [f"a{j} = v{j}", f"b{j} = v{j}", f"c{j} = v{j}"]
    return lines


def _runge_kutta(s: Shape) -> list[str]:
    """Classical RK4 from x to n with parameters pp: one step, all stages as scalars."""
    n = s.n_states
    stages = (
        ("k", [f"x{i}" for i in range(n)], "a"),
        ("f", [f"x{i} + h2 * k{i}" for i in range(n)], "b"),
        ("g", [f"x{i} + h2 * f{i}" for i in range(n)], "b"),
        ("d", [f"x{i} + h * g{i}" for i in range(n)], "c"),
    )
    lines = []
    for name, at, held in stages:
        args = f"{_tuple(at)}, {_tuple(f'{held}{j}' for j in range(s.n_inputs))}, pp"
        lines.append(f"{_targets(name, n)} = derivative({args})")
    lines += [f"n{i} = x{i} + h6 * (k{i} + 2.0 * (f{i} + g{i}) + d{i})" for i in range(n)]
    return lines


def _advance(s: Shape) -> str:
    lines = [
        "def advance(u, x, p, dt, n_steps, trace, outputs):",
        f"    pp = {_tuple(f'p[{i}]' for i in range(s.n_parameters))}",
        "    h = dt / n_steps",
        "    h2 = 0.5 * h",
        "    h6 = h / 6.0",
        *[f"    x{i} = x[{i}]" for i in range(s.n_states)],
        "    for k in range(u.shape[0] - 1):",
        *[f"        v{j} = u[k, {j}]" for j in range(s.n_inputs)],
        *[f"        {line}" for line in _outputs(s, "x{}", "p[{}]")],
        *[f"        outputs[k, {j}] = o{j}" for j in range(s.n_outputs)],
        *[f"        {line}" for line in _slopes(s)],
        "        for step in range(n_steps):",
        *[f"            {line}" for line in _stage_inputs(s)],
        *[f"            trace[k * n_steps + step, {i}] = x{i}" for i in range(s.n_states)],
        *[f"            {line}" for line in _runge_kutta(s)],
        *[f"            x{i} = n{i}" for i in range(s.n_states)],
        *[f"    x[{i}] = x{i}" for i in range(s.n_states)],
    ]
    return "\n".join(lines)


def _outputs(s: Shape, state: str, parameter: str) -> list[str]:
    """Lines that set the outputs o; the patterns name state and parameter number {}."""
    if s.output_states is not None:
        return [f"o{j} = {state.format(i)}" for j, i in enumerate(s.output_states)]
    x = _tuple(state.format(i) for i in range(s.n_states))
    u = _tuple(f"v{j}" for j in range(s.n_inputs))
    p = _tuple(parameter.format(i) for i in range(s.n_parameters))
    return [f"{_targets('o', s.n_outputs)} = output({x}, {u}, {p})"]


def _spectrum(s: Shape) -> str:
    n, m, r = s.n_states, s.n_inputs, s.n_parameters
    head = [
        "def spectrum(u, x, p, rate):",
        # Not a literal: the compiler would unroll the matrix products for seconds.
        "    n = x.shape[1]",
        "    J = np.empty((n, n))",
        "    T = np.empty((n, n))",
        f"    X = np.empty({n})",
        f"    F = np.empty({n})",
        "    for k in range(u.shape[0]):",
        "        for l in range(rate.shape[0]):",
    ]
    lines = [f"x{i} = x[k, {i}, l]" for i in range(n)]
    add = lines.append
    finite = " and ".join(f"math.isfinite(x{i})" for i in range(n))
    add(f"if not ({finite}):")
    add("    continue")
    add(f"uu = {_tuple(f'u[k, {j}]' for j in range(m))}")
    add(f"pp = {_tuple(f'p[{i}, l]' for i in range(r))}")
    for i in range(n):
        add(f"X[{i}] = x{i}")
    # Round -1 evaluates at the point itself; a single call site keeps compilation short.
    at = _tuple(f"X[{i}]" for i in range(n))
    lines += [
        f"for j in range(-1, {n}):",
        "    d = 0.0",
        "    if j >= 0:",
        "        kept = X[j]",
        "        d = 1e-7 * max(abs(kept), 1e-2)",
        "        X[j] = kept + d",
        f"    {_targets('a', n)} = derivative({at}, uu, pp)",
        "    if j < 0:",
    ]
    lines += [f"        F[{i}] = a{i}" for i in range(n)]
    lines += ["    else:", "        X[j] = kept"]
    lines += [f"        J[{i}, j] = (a{i} - F[{i}]) / d" for i in range(n)]
    lines += [
        "exponent = 0.0",
        f"for squaring in range({_SQUARINGS + 1}):",
        "    norm = 0.0",
        "    for i in range(n):",
        "        for j in range(n):",
        "            norm += J[i, j] * J[i, j]",
        "    norm = math.sqrt(norm)",
        "    if norm == 0.0:",
        "        exponent = -math.inf",
        "        break",
        "    if not math.isfinite(norm):",
        "        exponent = math.inf",
        "        break",
        "    exponent += math.log(norm) / 2.0 ** squaring",
        f"    if squaring == {_SQUARINGS}:",
        "        break",
        "    for i in range(n):",
        "        for j in range(n):",
        "            J[i, j] /= norm",
        "    for i in range(n):",
        "        for j in range(n):",
        "            t = 0.0",
        "            for q in range(n):",
        "                t += J[i, q] * J[q, j]",
        "            T[i, j] = t",
        "    for i in range(n):",
        "        for j in range(n):",
        "            J[i, j] = T[i, j]",
        "rate[l] = max(rate[l], math.exp(exponent))",
    ]
    return "\n".join(head + [" " * 12 + line for line in lines])


def _tuple(items: Iterable[str]) -> str:
    texts = list(items)
    return "(" + ", ".join(texts) + ("," if len(texts) == 1 else "") + ")"


def _targets(name: str, count: int) -> str:
    return ", ".join(f"{name}{i}" for i in range(count)) + ("," if count == 1 else "")
