"""Source text of the batch kernels, made for one model's shape and structure.

Lanes. Chromosomes are the innermost lanes: the work area is one-dimensional and indexed
``i*L + lane`` with L a literal, and one whole integration step stands in the lane loop, so that
LLVM turns each line into vector instructions. Two-dimensional arrays or an inner loop over
stages give scalar code, about five times slower (docs/decisions/0003-batch-kernel.md).

Scheme. x' = A x + N(x, t), with A the part of the equations that is linear with coefficients
fixed by the parameters. A is integrated exactly, N by the fourth-order exponential Runge-Kutta
method ETDRK4 (Cox & Matthews, "Exponential time differencing for stiff systems", Journal of
Computational Physics 176, 2002). Written in terms of f = A x + N with k the slope at the start:

    a = x + Q k                            D_a = f(a) - k - A (a - x)
    b = a + Q D_a                          D_b = f(b) - k - A (b - x)
    c = x + F k + 2 Q D_b                  D_c = f(c) - k - A (c - x)
    next = x + F k + G (D_a + D_b) + H D_c

    Q = h/2 phi_1(hA/2)    F = h phi_1    G = h (2 phi_2 - 4 phi_3)    H = h (4 phi_3 - phi_2)

The last term differs from what a linear change of N would give by e = G (D_a + D_b - D_c): the
estimate, one order lower, by which the steps of each chromosome are chosen.

With A = 0 this is the classical RK4. Where a row of N does not change within a sample, its D
is zero and costs nothing; entries of the matrices that the pattern of A keeps at zero are never
computed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sysid._structure import Structure, analyse
from sysid.model import ProcessModel

LANES = 16

# ||J^16||^(1/16) is an upper bound of the spectral radius that is tight to a few per cent.
_SQUARINGS = 4

_MATRICES = ("A", "Q", "F", "G", "H")
# Entries of Q, F, G, H in a row that A leaves alone: there phi_k is 1/k!.
_PLAIN = {"Q": "h2", "F": "h", "G": "h3", "H": "h6"}


@dataclass(frozen=True)
class Shape:
    """All that the kernel's text depends on."""

    n_states: int
    n_inputs: int
    n_outputs: int
    n_parameters: int
    foh: tuple[bool, ...]
    output_states: tuple[int, ...] | None
    initial: tuple[float, ...]
    structure: Structure

    @classmethod
    def of(cls, model: ProcessModel) -> Shape:
        """Shape of a model."""
        return cls(
            len(model.states),
            len(model.inputs),
            len(model.outputs),
            len(model.parameters),
            tuple(signal.hold == "foh" for signal in model.inputs),
            model.output_states,
            tuple(float(value) for value in model.initial_state),
            analyse(model),
        )

    def pattern(self, matrix: str) -> tuple[tuple[int, int], ...]:
        """Entries of a matrix of the scheme that are stored per lane."""
        if not self.structure.constant:
            return ()
        if matrix == "A":
            return self.structure.constant
        driven = self.structure.driven
        return tuple(
            (i, j)
            for i, j in self.structure.closure(self.n_states)
            if not self.plain(i) and (matrix in "QF" or j in driven)
        )

    def plain(self, row: int) -> bool:
        """Whether A leaves a row alone."""
        return all(i != row for i, _ in self.structure.constant)

    def place(self, kind: str, i: int, j: int = 0) -> int:
        """Row of the work area that holds state, parameter, error sum or matrix entry."""
        start = 0
        for name, size in self._sections():
            if name == kind:
                return start + (self.pattern(kind).index((i, j)) if kind in _MATRICES else i)
            start += size
        raise KeyError(kind)

    @property
    def work_size(self) -> int:
        """Floats in the work area of one block of lanes."""
        return sum(size for _, size in self._sections()) * LANES

    @property
    def fewest_steps(self) -> int:
        """Steps per sample below which the error estimate is not to be trusted.

        Fast linear parts that feed a nonlinear one swing within a sample: a single step of
        any size may happen to meet them at rest.
        """
        return 2 if self.structure.constant and self.structure.nonlinear else 1

    def _sections(self) -> list[tuple[str, int]]:
        sizes = [("state", self.n_states), ("parameter", self.n_parameters)]
        sizes += [("sum", self.n_outputs), ("estimate", self.n_outputs)]
        return sizes + [(name, len(self.pattern(name))) for name in _MATRICES]


def source(shape: Shape) -> str:
    """Python text of the kernels; needs np, math, phi_matrices, derivative, output as globals.

    ``simulate`` runs lanes of chromosomes over a record, ``spectrum`` bounds the fastest rate
    of what is not integrated exactly, ``advance`` runs one trajectory and keeps every step.
    ``simulate`` works in X, (work_size,) floats that start on a cache line.
    """
    return "\n\n".join((_prepare(shape), _simulate(shape), _spectrum(shape), _advance(shape), ""))


def _prepare(s: Shape) -> str:
    """Matrices of the scheme for one lane."""
    lines = ["def prepare(X, h, l, triples, J, M):"]
    add = lines.append
    columns = sorted({j for _, j in s.structure.constant})
    if not columns:
        return "\n".join([*lines, "    pass"])
    n = s.n_states
    # Always from the same point: A must not differ in its last bits with where a run begins.
    add(f"    uu = {_tuple('0.0' for _ in range(s.n_inputs))}")
    add(f"    pp = {_parameters(s)}")
    lines += [f"    x{i} = {value!r}" for i, value in enumerate(s.initial)]
    add(f"    {_targets('k', n)} = derivative({_tuple(f'x{i}' for i in range(n))}, uu, pp)")
    lines += ["    for i in range(J.shape[0]):", "        for j in range(J.shape[0]):"]
    add("            J[i, j] = 0.0")
    for j in columns:
        # The entries are constants: a unit step gives them without truncation error.
        moved = _tuple(f"x{i} + 1.0" if i == j else f"x{i}" for i in range(n))
        add(f"    {_targets('f', n)} = derivative({moved}, uu, pp)")
        lines += [f"    J[{i}, {j}] = f{i} - k{i}" for i, q in s.structure.constant if q == j]
    for i, j in s.pattern("A"):
        add(f"    X[{_at(s.place('A', i, j))}] = J[{i}, {j}]")
    add("    phi_matrices(J, h, triples, M)")
    values = {
        "Q": "M[0, {0}, {1}]",
        "F": "M[1, {0}, {1}]",
        "G": "2.0 * M[2, {0}, {1}] - 4.0 * M[3, {0}, {1}]",
        "H": "4.0 * M[3, {0}, {1}] - M[2, {0}, {1}]",
    }
    for name, value in values.items():
        for i, j in s.pattern(name):
            add(f"    X[{_at(s.place(name, i, j))}] = {value.format(i, j)}")
    return "\n".join(lines)


def _simulate(s: Shape) -> str:
    n, q, lanes = s.n_states, s.n_outputs, LANES
    first_sum = s.place("sum", 0)
    lines = [
        "def simulate(X, triples, u, y, w, start, p, dt, n_steps, sums, record):",
        "    n_samples = u.shape[0]",
        "    store = record.shape[0] > 0",
        *_step_sizes(),
        f"    for l in range({lanes}):",
        "        for i in range(start.shape[0]):",
        f"            X[i * {lanes} + l] = start[i, l]",
        "        for i in range(p.shape[0]):",
        f"            X[({n} + i) * {lanes} + l] = p[i, l]",
        f"        for i in range({2 * q}):",
        f"            X[({first_sum} + i) * {lanes} + l] = 0.0",
        "        prepare(X, h, l, triples, J, M)",
        "    for k in range(n_samples):",
    ]
    add = lines.append
    lines += [f"        v{j} = u[k, {j}]" for j in range(s.n_inputs)]
    for j in range(q):
        add(f"        y{j} = y[k, {j}]")
        add(f"        w{j} = w[k, {j}]")
    outputs = _lane_outputs(s)
    add(f"        for l in range({lanes}):")
    lines += [" " * 12 + line for line in outputs]
    for j in range(q):
        add(f"            e = (o{j} - y{j}) * w{j}")
        add(f"            X[{_at(s.place('sum', j))}] += e * e")
    add("        if store:")
    add(f"            for l in range({lanes}):")
    lines += [" " * 16 + line for line in outputs]
    lines += [f"                record[k, {j}, l] = o{j}" for j in range(q)]
    add("        if k == n_samples - 1:")
    add("            break")
    # A block in which every chromosome has blown up has nothing more to say.
    add("        if k % 64 == 63:")
    add("            alive = False")
    add(f"            for l in range({lanes}):")
    total = " + ".join(f"X[{_at(s.place('sum', j))}]" for j in range(q))
    add(f"                alive = alive or math.isfinite({total})")
    add("            if not alive:")
    add("                break")
    lines += [" " * 8 + line for line in _slopes(s)]
    add("        for step in range(n_steps):")
    lines += [" " * 12 + line for line in _stage_inputs(s)]
    add(f"            for l in range({lanes}):")
    lines += [" " * 16 + line for line in _exponential_step(s)]
    lines += [" " * 16 + line for line in _estimate(s)]
    add(f"    for j in range({2 * q}):")
    add(f"        for l in range({lanes}):")
    add(f"            sums[j, l] = X[({first_sum} + j) * {lanes} + l]")
    return "\n".join(lines)


def _exponential_step(s: Shape) -> list[str]:
    """One ETDRK4 step of lane l, as scalars."""
    n = s.n_states
    lines = [f"x{i} = X[{_at(s.place('state', i))}]" for i in range(n)]
    lines.append(f"pp = {_parameters(s)}")
    lines += _slope(s, "k", "x", "a")
    lines += [f"a{i}_ = x{i}{_product(s, 'Q', i, 'k')}" for i in range(n)]
    lines += [f"g{i}_ = x{i}{_product(s, 'F', i, 'k')}" for i in range(n)]
    lines += _defect(s, "a", "b")
    lines += [f"b{i}_ = a{i}_{_product(s, 'Q', i, 'da')}" for i in range(n)]
    lines += _defect(s, "b", "b")
    lines += [f"c{i}_ = g{i}_{_product(s, 'Q', i, 'db', '2.0 * ')}" for i in range(n)]
    lines += _defect(s, "c", "c")
    lines += [f"s{i} = da{i} + db{i}" for i in s.structure.driven]
    lines += [
        f"n{i} = g{i}_{_product(s, 'G', i, 's')}{_product(s, 'H', i, 'dc')}" for i in range(n)
    ]
    lines += [f"X[{_at(s.place('state', i))}] = n{i}" for i in range(n)]
    return lines


def _estimate(s: Shape) -> list[str]:
    """Add the step's error estimate, as it shows in the outputs, to the lane's sums."""
    n = s.n_states
    lines = [f"t{i} = s{i} - dc{i}" for i in s.structure.driven]
    terms = [_product(s, "G", i, "t").removeprefix(" + ") for i in range(n)]
    if s.output_states is not None:
        errors = [terms[i] for i in s.output_states]
    elif any(terms):
        u = _tuple(f"c{j}" for j in range(s.n_inputs))
        here = _tuple(f"n{i}" for i in range(n))
        moved = _tuple(f"n{i} - ({term})" if term else f"n{i}" for i, term in enumerate(terms))
        lines.append(f"{_targets('o', s.n_outputs)} = output({here}, {u}, pp)")
        lines.append(f"{_targets('m', s.n_outputs)} = output({moved}, {u}, pp)")
        errors = [f"o{j} - m{j}" for j in range(s.n_outputs)]
    else:
        errors = []
    for j, error in enumerate(errors):
        if error:
            lines.append(f"e = {error}")
            lines.append(f"X[{_at(s.place('estimate', j))}] += e * e")
    return lines


def _slope(s: Shape, target: str, at: str, held: str) -> list[str]:
    x = _tuple(f"{at}{i}" for i in range(s.n_states))
    u = _tuple(f"{held}{j}" for j in range(s.n_inputs))
    return [f"{_targets(target, s.n_states)} = derivative({x}, {u}, pp)"]


def _defect(s: Shape, stage: str, held: str) -> list[str]:
    """D of a stage: how far N has moved from its value at the start of the step."""
    if not s.structure.driven:
        return []
    x = _tuple(f"{stage}{i}_" for i in range(s.n_states))
    u = _tuple(f"{held}{j}" for j in range(s.n_inputs))
    lines = [f"{_targets('f', s.n_states)} = derivative({x}, {u}, pp)"]
    for i in s.structure.driven:
        linear = "".join(
            f" - X[{_at(s.place('A', i, j))}] * ({stage}{j}_ - x{j})"
            for row, j in s.structure.constant
            if row == i
        )
        lines.append(f"d{stage}{i} = f{i} - k{i}{linear}")
    return lines


def _product(s: Shape, matrix: str, row: int, vector: str, factor: str = "") -> str:
    """`` + M[row, j] * vector_j`` for the entries of a row that are not zero."""
    known = range(s.n_states) if vector == "k" else s.structure.driven
    if s.plain(row):
        if row not in known:
            return ""
        return f" + {factor}{_PLAIN[matrix]} * {vector}{row}"
    return "".join(
        f" + {factor}X[{_at(s.place(matrix, i, j))}] * {vector}{j}"
        for i, j in s.pattern(matrix)
        if i == row and j in known
    )


def _slopes(s: Shape) -> list[str]:
    """Change per step of the interpolated inputs in the interval from sample k."""
    return [f"s{j}_ = (u[k + 1, {j}] - v{j}) / n_steps" for j, foh in enumerate(s.foh) if foh]


def _stage_inputs(s: Shape) -> list[str]:
    """Inputs at the start (a), middle (b) and end (c) of a step."""
    lines = []
    for j, foh in enumerate(s.foh):
        if foh:
            lines += [f"a{j} = v{j} + s{j}_ * step", f"b{j} = a{j} + 0.5 * s{j}_"]
            lines.append(f"c{j} = a{j} + s{j}_")
        else:
            lines += [f"a{j} = v{j}", f"b{j} = v{j}", f"c{j} = v{j}"]
    return lines


def _lane_outputs(s: Shape) -> list[str]:
    """Lines that set the outputs o from lane l's state."""
    if s.output_states is not None:
        return [f"o{j} = X[{_at(i)}]" for j, i in enumerate(s.output_states)]
    x = _tuple(f"X[{_at(i)}]" for i in range(s.n_states))
    u = _tuple(f"v{j}" for j in range(s.n_inputs))
    return [f"{_targets('o', s.n_outputs)} = output({x}, {u}, {_parameters(s)})"]


def _spectrum(s: Shape) -> str:
    """Bound on the fastest rate of N.

    Only the driven rows of its Jacobian are not zero, so that its eigenvalues are those of the
    block of driven rows and columns.
    """
    rows = s.structure.driven
    r = len(rows)
    head = ["def spectrum(u, x, p, rate):"]
    if not rows:
        return "\n".join([*head, "    pass"])
    head += [
        # Not a literal: the compiler would unroll the matrix products for seconds.
        f"    n = min(x.shape[1], {r})",
        "    J = np.empty((n, n))",
        "    T = np.empty((n, n))",
        f"    X = np.empty({s.n_states})",
        f"    F = np.empty({r})",
        "    for k in range(u.shape[0]):",
        "        for l in range(rate.shape[0]):",
    ]
    lines = [f"X[{i}] = x[k, {i}, l]" for i in range(s.n_states)]
    add = lines.append
    finite = " and ".join(f"math.isfinite(X[{i}])" for i in range(s.n_states))
    add(f"if not ({finite}):")
    add("    continue")
    add(f"uu = {_tuple(f'u[k, {j}]' for j in range(s.n_inputs))}")
    add(f"pp = {_tuple(f'p[{i}, l]' for i in range(s.n_parameters))}")
    # Round -1 evaluates at the point itself; a single call site keeps compilation short.
    at = _tuple(f"X[{i}]" for i in range(s.n_states))
    lines += [
        f"for j in range(-1, {r}):",
        "    d = 0.0",
        "    q = 0",
        "    kept = X[0]",
        "    if j >= 0:",
        *[f"        q = {row} if j == {j} else q" for j, row in enumerate(rows)],
        "        kept = X[q]",
        "        d = 1e-7 * max(abs(kept), 1e-2)",
        "        X[q] = kept + d",
        f"    {_targets('a', s.n_states)} = derivative({at}, uu, pp)",
        "    if j < 0:",
        *[f"        F[{i}] = a{row}" for i, row in enumerate(rows)],
        "    else:",
        "        X[q] = kept",
        *[f"        J[{i}, j] = (a{row} - F[{i}]) / d" for i, row in enumerate(rows)],
    ]
    # What is integrated exactly does not limit the step.
    lines += [
        f"J[{rows.index(i)}, {rows.index(j)}] = 0.0"
        for i, j in s.structure.constant
        if i in rows and j in rows
    ]
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


def _advance(s: Shape) -> str:
    """One trajectory, by the same step in lane 0."""
    n = s.n_states
    lines = [
        "def advance(X, triples, u, x, p, dt, n_steps, trace, outputs):",
        "    l = 0",
        *_step_sizes(),
        "    for i in range(x.shape[0]):",
        f"        X[i * {LANES}] = x[i]",
        "    for i in range(p.shape[0]):",
        f"        X[({n} + i) * {LANES}] = p[i]",
        "    prepare(X, h, l, triples, J, M)",
        "    for k in range(u.shape[0] - 1):",
        *[f"        v{j} = u[k, {j}]" for j in range(s.n_inputs)],
        *[f"        {line}" for line in _lane_outputs(s)],
        *[f"        outputs[k, {j}] = o{j}" for j in range(s.n_outputs)],
        *[f"        {line}" for line in _slopes(s)],
        "        for step in range(n_steps):",
        *[f"            {line}" for line in _stage_inputs(s)],
        "            for i in range(x.shape[0]):",
        f"                trace[k * n_steps + step, i] = X[i * {LANES}]",
        *[f"            {line}" for line in _exponential_step(s)],
        "    for i in range(x.shape[0]):",
        f"        x[i] = X[i * {LANES}]",
    ]
    return "\n".join(lines).replace("start.shape", "x.shape")


def _step_sizes() -> list[str]:
    return [
        "    h = dt / n_steps",
        "    h2 = 0.5 * h",
        "    h3 = h / 3.0",
        "    h6 = h / 6.0",
        "    J = np.empty((start.shape[0], start.shape[0]))",
        "    M = np.empty((4, start.shape[0], start.shape[0]))",
    ]


def _at(row: int) -> str:
    """Index of lane l in a row of the work area."""
    return f"{row * LANES} + l"


def _parameters(s: Shape) -> str:
    places = (_at(s.place("parameter", i)) for i in range(s.n_parameters))
    return _tuple(f"X[{place}]" for place in places)


def _tuple(items: Iterable[str]) -> str:
    texts = list(items)
    return "(" + ", ".join(texts) + ("," if len(texts) == 1 else "") + ")"


def _targets(name: str, count: int) -> str:
    return ", ".join(f"{name}{i}" for i in range(count)) + ("," if count == 1 else "")
