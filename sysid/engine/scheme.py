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

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.engine.bends import splines_of
from sysid.engine.program import listed
from sysid.engine.structure import Structure
from sysid.problem.model import ProcessModel

LANES = 16  # chromosomes in a block
# Parts of a step h that rows need which A leaves alone.
STEP_SIZES = ("h2 = 0.5 * h", "h3 = h / 3.0", "h6 = h / 6.0")

_MATRICES = "QFGH"
_PLAIN = {"F": "h", "G": "h3"}  # what they are for such a row, where phi_k is 1/k!


class Scheme:
    """Lines of code of which the kernels of a model are made.

    guarded: rows of N that guarded numbers count in. twins: for each state that of the first group
    of linked ones that A treats alike, itself where there is none before: deviations by several
    causes have one A. closure: entries of exp(A t) that can differ from zero, of first groups.
    entries: matrix and place in it of all that is stored, in order. fewest_steps: per sample, below
    which the error estimate is not to be trusted.
    """

    first_row = 0

    def __init__(self, model: ProcessModel, structure: Structure) -> None:
        self.structure = structure
        self.n_states, self.n_inputs = structure.n_states, structure.n_inputs
        self.n_outputs, self.n_parameters = structure.n_outputs, structure.n_parameters
        self.n_constants = structure.n_constants
        self.n_margins = sum(guard.n_limits for guard in structure.guards)
        self.output_states = structure.output_states
        self.n_recorded = len(model.inputs)
        self.recorded_slopes = [j for j, u in enumerate(model.inputs) if u.hold != "zoh"]
        # Whatever stands behind a record's inputs rises within a sample.
        self.interpolated = [*self.recorded_slopes, *range(self.n_recorded, self.n_inputs)]
        self.splines = splines_of(model)
        self.counts = {
            "remainder": self.n_states,
            "observe": self.n_outputs,
            "margins": self.n_margins,
        }
        self.guarded = sorted({i for guard in structure.guards for i in guard.gains})
        self._groups = self._linked_states()
        self.twins = self._first_alike()
        self.closure = self._closure()
        driven = {self.twins[j] for j in structure.driven}
        self.entries = [
            (matrix, (i, j))
            for matrix in _MATRICES
            for i, j in self.closure
            if not self.plain(i) and (matrix in "QF" or j in driven)
        ]
        self.n_entries = len(self.entries)
        # Fast linear parts that feed a nonlinear one swing within a sample: a single step of any
        # size may happen to meet them at rest.
        self.fewest_steps = 2 if structure.coefficients and structure.nonlinear else 1

    def _place(self, entry: int) -> str:
        """Where an entry of the matrices stands."""
        raise NotImplementedError

    def _linked_states(self) -> list[list[int]]:
        """For each state all that A links it with, directly or through others, in order."""
        groups = [[i] for i in range(self.n_states)]
        for i, j in self.structure.coefficients:
            if groups[i] is not groups[j]:
                merged = sorted(groups[i] + groups[j])
                for k in merged:
                    groups[k] = merged
        return groups

    def _first_alike(self) -> list[int]:
        coefficients = self.structure.coefficients
        first: dict[tuple[str | None, ...], list[int]] = {}
        twins = list(range(self.n_states))
        for i, group in enumerate(self._groups):
            texts = tuple(coefficients.get((row, column)) for row in group for column in group)
            twins[i] = first.setdefault(texts, group)[group.index(i)]
        return twins

    def _closure(self) -> list[tuple[int, int]]:
        states = sorted(set(self.twins))
        reach = {(i, i) for i in states}
        reach |= {(i, j) for i, j in self.structure.coefficients if self.twins[i] == i}
        for k in states:
            via = [i for i in states if (i, k) in reach]
            to = [j for j in states if (k, j) in reach]
            reach |= {(i, j) for i in via for j in to}
        return sorted(reach)

    @cached_property
    def tables(self) -> tuple[IntArray, ...]:
        """Tables of ``scheme_matrices`` for matrices that stand from row ``first_row`` on."""
        number = {entry: k for k, entry in enumerate(self.closure)}
        triples = [
            (number[i, k], number[k, j], number[i, j])
            for i, k in self.closure
            for row, j in self.closure
            if row == k
        ]
        stored = {entry: self.first_row + k for k, entry in enumerate(self.entries)}
        places = [[stored.get((matrix, at), -1) for at in self.closure] for matrix in _MATRICES]
        return tuple(np.array(table, dtype=np.int64) for table in (self.closure, triples, places))

    def plain(self, row: int) -> bool:
        """Whether A leaves a row alone."""
        return all(i != row for i, _ in self.structure.coefficients)

    def fill(self) -> list[str]:
        """Lines that set lane l of A, in the order of its closure, from the constants c."""
        return [
            f"A[{self.closure.index(entry)}, l] = {coefficient}"
            for entry, coefficient in sorted(self.structure.coefficients.items())
            if self.twins[entry[0]] == entry[0]
        ]

    def call(
        self, function: str, target: str, x: str | Sequence[str], u: str | Sequence[str]
    ) -> list[str]:
        """Line that sets numbered targets to a function of the program.

        x, u: states and inputs, a name to number or their texts.
        """
        targets = numbered(target, self.counts[function])
        states = numbered(x, self.n_states) if isinstance(x, str) else x
        inputs = numbered(u, self.n_inputs) if isinstance(u, str) else u
        comma = "," if len(targets) == 1 else ""
        return [f"{', '.join(targets)}{comma} = {function}({listed(states)}, {listed(inputs)}, c)"]

    def slope(self, x: str, u: str, n: str, k: str) -> list[str]:
        """N and the whole slope k at a state x with inputs u, each a name to number."""
        lines = self.call("remainder", n, x, u)
        coefficients = sorted(self.structure.coefficients.items())
        for i in range(self.n_states):
            terms = [f"{c} * {x}{j}" for (row, j), c in coefficients if row == i]
            lines.append(f"{k}{i} = " + " + ".join([*terms, f"{n}{i}"]))
        return lines

    def stage_inputs(self, begun: str, share: str = "") -> list[str]:
        """Inputs at the start (a), middle (b) and end (c) of a step.

        v are those of the sample, i what interpolated ones change by in a base step; begun: base
        steps that have passed; share: factor, how much of a base step this one is.
        """
        lines = []
        for j in range(self.n_inputs):
            if j in self.interpolated:
                lines += [f"ua{j} = v{j} + i{j} * {begun}", f"ub{j} = ua{j} + 0.5 * {share}i{j}"]
                lines.append(f"uc{j} = ua{j} + {share}i{j}")
            else:
                lines += [f"u{stage}{j} = v{j}" for stage in "abc"]
        return lines

    def step(self) -> list[str]:
        """One step from x0.. to n0.., given N and slope m0.., k0.. at its start, inputs ub, uc."""
        lines = self._stage("a", "ub", "h2 * k", "x", "k")
        lines += self._stage("b", "ub", "h2 * ra", "xa", "da")
        lines += [f"g{i} = x{i}{self._product('F', i, 'k')}" for i in range(self.n_states)]
        lines += self._stage("c", "uc", "h * rb", "g", "db", "2.0 * ")
        for i in self.structure.driven:
            lines += [f"s{i} = da{i} + db{i}", f"v_{i} = ra{i} + rb{i}", f"w_{i} = m{i} + rc{i}"]
        return lines + [f"n{i} = {self._end(i)}" for i in range(self.n_states)]

    def _stage(
        self, stage: str, inputs: str, plain: str, start: str, vector: str, factor: str = ""
    ) -> list[str]:
        """The states of a stage, N there and how far it has moved; plain: step of plain rows."""
        if not self.structure.driven:
            return []
        lines = [
            f"x{stage}{i} = x{i} + {plain}{i}"
            if self.plain(i)
            else f"x{stage}{i} = {start}{i}{self._product('Q', i, vector, factor=factor)}"
            for i in range(self.n_states)
        ]
        lines += self.call("remainder", f"r{stage}", f"x{stage}", inputs)
        return lines + [f"d{stage}{i} = r{stage}{i} - m{i}" for i in self.structure.driven]

    def _end(self, i: int) -> str:
        if not self.plain(i):
            return f"g{i}{self._product('G', i, 's')}{self._product('H', i, 'dc')}"
        if i not in self.structure.driven:
            return f"x{i} + h * k{i}"
        return f"x{i} + h6 * (w_{i} + 2.0 * v_{i})"

    def _product(
        self,
        matrix: str,
        row: int,
        vector: str,
        columns: Iterable[int] | None = None,
        factor: str = "",
    ) -> str:
        """`` + M[row, j] * vector_j`` over columns j, by default all for k, else driven rows."""
        if columns is None:
            columns = range(self.n_states) if vector == "k" else self.structure.driven
        if self.plain(row):
            return f" + {_PLAIN[matrix]} * {vector}{row}" if row in columns else ""
        place = {entry: k for k, entry in enumerate(self.entries)}
        pairs = [(j, (matrix, (self.twins[row], self.twins[j]))) for j in self._groups[row]]
        return "".join(
            f" + {factor}{self._place(place[entry])} * {vector}{j}"
            for j, entry in pairs
            if j in columns and entry in place
        )

    def error_of_n(self) -> list[str]:
        """After a step, t: by how much the change of N was not linear; G t estimates the error."""
        return [f"t{i} = v_{i} - w_{i}" for i in self.structure.driven]

    def effects(self, vector: str, rows: Iterable[int]) -> list[str]:
        """What an error ``vector`` in such rows of N does to each state, empty for nothing."""
        return [
            self._product("G", i, vector, rows).removeprefix(" + ") for i in range(self.n_states)
        ]

    def margins(self, x: str, u: str, target: str) -> list[str]:
        """How far each guarded number is above each of its limits."""
        return self.call("margins", target, x, u) if self.n_margins else []

    def missed(self) -> list[str]:
        """Bound f, in each row of N, on what a limit may have done between the ends of a step.

        A fast linear part may swing beyond a limit and back while no stage looks. The tangents at
        both ends bound how far: between them a swing is concave. Where the ends are on different
        sides of the limit the stages see it, and the error estimate is large enough by itself.
        """
        lines = []
        first = 0
        for g, guard in enumerate(self.structure.guards):
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
        for row in self.guarded:
            terms = [
                f"abs({guard.gains[row]}) * far_{g}"
                for g, guard in enumerate(self.structure.guards)
                if row in guard.gains
            ]
            lines.append(f"f{row} = " + " + ".join(terms))
        return lines


def numbered(name: str, count: int) -> list[str]:
    """name0, name1, .."""
    return [f"{name}{i}" for i in range(count)]


def work_area(size: int) -> FloatArray:
    """Floats starting on a cache line: vector loads that straddle lines take twice as long."""
    raw = np.empty(size + 8)
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + size]
