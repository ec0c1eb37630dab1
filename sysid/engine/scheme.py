"""The integration scheme as source text, made for one model's shape and structure.

x' = A x + N(x, t), with A the part of the equations that is linear with coefficients fixed by
the parameters. A is integrated exactly, N by the fourth-order exponential Runge-Kutta method
ETDRK4 (Cox & Matthews, "Exponential time differencing for stiff systems", Journal of
Computational Physics 176, 2002). With k the slope at the start and D how far N has moved:

    a = x + Q k                            D_a = N(a) - N(x)
    b = a + Q D_a                          D_b = N(b) - N(x)
    c = x + F k + 2 Q D_b                  D_c = N(c) - N(x)
    next = x + F k + G (D_a + D_b) + H D_c

    Q = h/2 phi_1(hA/2)    F = h phi_1    G = h (2 phi_2 - 4 phi_3)    H = h (4 phi_3 - phi_2)

The last term differs from what a linear change of N would give by e = G (D_a + D_b - D_c): the
estimate, one order lower, by which the steps are chosen.

Rows that A leaves alone take the classical RK4, which this is for A = 0. Where a row of N does
not change within a sample, its D is zero and costs nothing; entries of the matrices that the
pattern of A keeps at zero are never computed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sysid.engine.program import listed
from sysid.engine.structure import Entry, Structure, analyse
from sysid.problem.model import ProcessModel

MATRICES = "QFGH"

# Where an entry of the matrices, counted through, stands.
Place = Callable[[int], str]


@dataclass(frozen=True)
class Shape:
    """All that the kernels' text depends on."""

    n_states: int
    n_inputs: int
    n_outputs: int
    n_parameters: int
    foh: tuple[bool, ...]
    spline: tuple[bool, ...]
    output_states: tuple[int, ...] | None
    structure: Structure

    @classmethod
    def of(cls, model: ProcessModel, structure: Structure | None = None) -> Shape:
        """Shape of a model, taken apart as it comes or as given."""
        return cls(
            len(model.states),
            len(model.inputs),
            len(model.outputs),
            len(model.parameters),
            tuple(signal.hold != "zoh" for signal in model.inputs),
            tuple(signal.hold == "spline" for signal in model.inputs),
            model.output_states,
            structure or analyse(model),
        )

    @property
    def n_constants(self) -> int:
        """Numbers that the parameters fix and the equations need."""
        return self.structure.program.n_constants

    @property
    def n_margins(self) -> int:
        """Limits that are guarded."""
        return sum(guard.n_limits for guard in self.structure.guards)

    @property
    def guarded(self) -> list[int]:
        """Rows of N that guarded numbers count in."""
        return sorted({i for guard in self.structure.guards for i in guard.gains})

    @property
    def n_entries(self) -> int:
        """Entries of all matrices that are stored."""
        return len(self.entries())

    def entries(self) -> list[tuple[str, Entry]]:
        """Matrix and place in it of all stored entries, in their order."""
        return [(name, entry) for name in MATRICES for entry in self.pattern(name)]

    def places(self, first: int) -> list[list[int]]:
        """For each matrix and entry of the closure where it is stored, from ``first`` on, or -1."""
        stored = {entry: first + k for k, entry in enumerate(self.entries())}
        closure = self.structure.closure(self.n_states)
        return [[stored.get((name, entry), -1) for entry in closure] for name in MATRICES]

    @property
    def fewest_steps(self) -> int:
        """Steps per sample below which the error estimate is not to be trusted.

        Fast linear parts that feed a nonlinear one swing within a sample: a single step of
        any size may happen to meet them at rest.
        """
        return 2 if self.structure.coefficients and self.structure.nonlinear else 1

    def pattern(self, matrix: str) -> tuple[Entry, ...]:
        """Entries of a matrix that are stored."""
        driven = self.structure.driven
        return tuple(
            (i, j)
            for i, j in self.structure.closure(self.n_states)
            if not self.plain(i) and (matrix in "QF" or j in driven)
        )

    def plain(self, row: int) -> bool:
        """Whether A leaves a row alone."""
        return all(i != row for i, _ in self.structure.coefficients)


def slope(s: Shape, x: str, u: str, n: str, k: str) -> list[str]:
    """N and the whole slope k at a state x with inputs u, each a name to number."""
    lines = call("remainder", n, s.n_states, numbered(x, s.n_states), numbered(u, s.n_inputs))
    for i in range(s.n_states):
        terms = [
            f"{c} * {x}{j}" for (row, j), c in sorted(s.structure.coefficients.items()) if row == i
        ]
        lines.append(f"{k}{i} = " + " + ".join([*terms, f"{n}{i}"]))
    return lines


def step(s: Shape, place: Place) -> list[str]:
    """One step from x0.. to n0.., given N and slope m0.., k0.. at its start and inputs ub, uc."""
    lines = _stage(s, "a", "ub", [_first(s, i, place) for i in range(s.n_states)])
    lines += _stage(s, "b", "ub", [_second(s, i, place) for i in range(s.n_states)])
    lines += [f"g{i} = x{i}{product(s, 'F', i, 'k', place)}" for i in range(s.n_states)]
    lines += _stage(s, "c", "uc", [_third(s, i, place) for i in range(s.n_states)])
    for i in s.structure.driven:
        lines += [f"s{i} = da{i} + db{i}", f"v_{i} = ra{i} + rb{i}", f"w_{i} = m{i} + rc{i}"]
    lines += [f"n{i} = {_last(s, i, place)}" for i in range(s.n_states)]
    return lines


def error_of_n(s: Shape) -> list[str]:
    """After a step, t: by how much the change of N was not linear; G t estimates the error."""
    return [f"t{i} = v_{i} - w_{i}" for i in s.structure.driven]


def effects(s: Shape, vector: str, rows: Iterable[int], place: Place) -> list[str]:
    """What an error ``vector`` in such rows of N does to each state, empty for nothing."""
    return [
        product(s, "G", i, vector, place, columns=rows).removeprefix(" + ")
        for i in range(s.n_states)
    ]


def margins(s: Shape, x: str, u: str, target: str) -> list[str]:
    """How far each guarded number is above each of its limits."""
    if not s.n_margins:
        return []
    return call("margins", target, s.n_margins, numbered(x, s.n_states), numbered(u, s.n_inputs))


def missed(s: Shape) -> list[str]:
    """Bound f, in each row of N, on what a limit may have done between the ends of a step.

    A fast linear part may swing beyond a limit and back while no stage looks. The tangents at
    both ends bound how far: between them a swing is concave. Where the ends are on different
    sides of the limit the stages see it, and the error estimate is large enough by itself.
    """
    lines = []
    first = 0
    for g, guard in enumerate(s.structure.guards):
        for end, k in (("rise", "k"), ("fall", "kn")):
            slopes = " + ".join(f"{c} * {k}{j}" for j, c in sorted(guard.slopes.items()))
            lines.append(f"{end} = h2 * ({slopes})")
        lines.append("far = 0.0")
        for i in range(first, first + guard.n_limits):
            lines.append(f"side = -1.0 if q{i} > 0.0 else 1.0")
            lines.append(f"beyond = max(side * (q{i} + rise), side * (r{i} - fall))")
            lines.append(f"far = max(far, beyond if (q{i} > 0.0) == (r{i} > 0.0) else 0.0)")
        first += guard.n_limits
        lines.append(f"far_{g} = far")
    for row in s.guarded:
        terms = [
            f"abs({guard.gains[row]}) * far_{g}"
            for g, guard in enumerate(s.structure.guards)
            if row in guard.gains
        ]
        lines.append(f"f{row} = " + " + ".join(terms))
    return lines


def stage_inputs(s: Shape, begun: str, share: str = "") -> list[str]:
    """Inputs at the start (a), middle (b) and end (c) of a step.

    v are those of the sample, i what interpolated ones change by in a base step; begun: base
    steps that have passed; share: factor, how much of a base step this one is.
    """
    lines = []
    for j, foh in enumerate(s.foh):
        if foh:
            lines += [f"ua{j} = v{j} + i{j} * {begun}", f"ub{j} = ua{j} + 0.5 * {share}i{j}"]
            lines.append(f"uc{j} = ua{j} + {share}i{j}")
        else:
            lines += [f"u{stage}{j} = v{j}" for stage in "abc"]
    return lines


def step_sizes() -> list[str]:
    """Parts of a step h that plain rows need."""
    return ["h2 = 0.5 * h", "h3 = h / 3.0", "h6 = h / 6.0"]


def fill(s: Shape) -> list[str]:
    """Lines that set lane l of A, in the order of its closure, from the constants c."""
    entries = s.structure.closure(s.n_states)
    return [
        f"A[{entries.index(entry)}, l] = {coefficient}"
        for entry, coefficient in sorted(s.structure.coefficients.items())
    ]


# A row that A leaves alone: phi_k is 1/k!.
_PLAIN = {"F": "h", "G": "h3"}


def product(
    s: Shape,
    matrix: str,
    row: int,
    vector: str,
    place: Place,
    *,
    factor: str = "",
    columns: Iterable[int] | None = None,
) -> str:
    """`` + M[row, j] * vector_j`` for the entries of a row that are not zero.

    columns: the j for which there is a vector_j; default all for k, else the driven rows.
    """
    if columns is None:
        columns = range(s.n_states) if vector == "k" else s.structure.driven
    columns = set(columns)
    if s.plain(row):
        return f" + {_PLAIN[matrix]} * {vector}{row}" if row in columns else ""
    entries = s.entries()
    return "".join(
        f" + {factor}{place(entries.index((matrix, (i, j))))} * {vector}{j}"
        for i, j in s.pattern(matrix)
        if i == row and j in columns
    )


def call(function: str, target: str, count: int, x: Sequence[str], u: Sequence[str]) -> list[str]:
    """Line that sets the targets to a function of the program."""
    return [f"{targets(target, count)} = {function}({listed(x)}, {listed(u)}, c)"]


def targets(name: str, count: int) -> str:
    """Names to assign a tuple of results to."""
    return ", ".join(numbered(name, count)) + ("," if count == 1 else "")


def numbered(name: str, count: int) -> list[str]:
    """name0, name1, .."""
    return [f"{name}{i}" for i in range(count)]


def _stage(s: Shape, stage: str, inputs: str, at: list[str]) -> list[str]:
    """The states of a stage, N there and how far it has moved."""
    if not s.structure.driven:
        return []
    lines = [f"x{stage}{i} = {text}" for i, text in enumerate(at)]
    lines += call(
        "remainder",
        f"r{stage}",
        s.n_states,
        numbered(f"x{stage}", s.n_states),
        numbered(inputs, s.n_inputs),
    )
    return lines + [f"d{stage}{i} = r{stage}{i} - m{i}" for i in s.structure.driven]


def _first(s: Shape, i: int, place: Place) -> str:
    return f"x{i} + h2 * k{i}" if s.plain(i) else f"x{i}{product(s, 'Q', i, 'k', place)}"


def _second(s: Shape, i: int, place: Place) -> str:
    if s.plain(i):
        return f"x{i} + h2 * ra{i}"
    return f"xa{i}{product(s, 'Q', i, 'da', place)}"


def _third(s: Shape, i: int, place: Place) -> str:
    if s.plain(i):
        return f"x{i} + h * rb{i}"
    return f"g{i}{product(s, 'Q', i, 'db', place, factor='2.0 * ')}"


def _last(s: Shape, i: int, place: Place) -> str:
    if not s.plain(i):
        return f"g{i}{product(s, 'G', i, 's', place)}{product(s, 'H', i, 'dc', place)}"
    if i not in s.structure.driven:
        return f"x{i} + h * k{i}"
    return f"x{i} + h6 * (w_{i} + 2.0 * v_{i})"
