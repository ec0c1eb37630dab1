"""Source text of the batch kernels: lanes of chromosomes over a record.

Chromosomes are the innermost lanes: the work area is one-dimensional and indexed
``i*L + lane`` with L a literal, and one whole integration step stands in the lane loop, so that
LLVM turns each line into vector instructions. Two-dimensional arrays or an inner loop over
stages give scalar code, about five times slower (docs/decisions/0003-batch-kernel.md).
"""

import re
from collections.abc import Sequence

from sysid.engine.program import block, listed
from sysid.engine.scheme import LANES, STEP_SIZES, Scheme
from sysid.engine.structure import Structure
from sysid.problem.model import ProcessModel

_STAGES = {"a": "0.0", "b": "0.5", "c": "1.0"}  # and how much of a step has passed
EACH_LANE = f"for l in range({LANES}):"


class BatchKernel(Scheme):
    """Text of the batch kernels; needs math, wide_vectors, the program and what
    is compiled once for all models, ``scheme_matrices`` and ``parts``.

    ``simulate`` runs lanes of chromosomes over a record, ``spectrum`` bounds the fastest rate
    of what is not integrated exactly. The work area holds rows of lanes: states, constants, sums
    of squared residuals, those of error estimates, the residuals of a sample, and from
    ``first_row`` on the matrices.
    """

    def __init__(self, model: ProcessModel, structure: Structure) -> None:
        super().__init__(model, structure)
        self._sums = self.n_states + self.n_constants
        self._estimates = self._sums + self.n_outputs
        self._errors = self._estimates + self.n_outputs
        self.first_row = self._errors + self.n_outputs
        self.work_rows = self.first_row + self.n_entries

    def text(self, *, many_registers: bool) -> str:
        """Python text of both."""
        # Plain Runge-Kutta keeps so much at hand that two lanes at once need room for it.
        paired = many_registers or bool(self.structure.coefficients)
        return "\n\n".join((self._simulate(paired), self._spectrum(), ""))

    def _place(self, entry: int) -> str:
        return at(self.first_row + entry)

    def _constants(self) -> str:
        return "c = " + listed(at(self.n_states + i) for i in range(self.n_constants))

    def _simulate(self, paired: bool) -> str:
        q = self.n_outputs
        squares = [
            line
            for j in range(q)
            for line in (
                f"e = (o{j} - y{j}) * w{j}",
                f"{at(self._errors + j)} = e",
                f"{at(self._sums + j)} += e * e",
            )
        ]
        total = " + ".join(at(self._sums + j) for j in range(q))
        sample = [
            *[f"v{j} = u[k, {j}]" for j in range(self.n_inputs)],
            *[f"{name}{j} = {name}[k, {j}]" for name in "yw" for j in range(q)],
            *block(EACH_LANE, self._outputs(), squares),
            *block("if record.shape[0] > 0:", residuals_kept(q, self._errors)),
            *block("if k == n_samples - 1:", ["break"]),
            # A block in which all chromosomes have blown up has nothing more to say.
            *block(
                "if k % 64 == 63:",
                ["alive = False"],
                block(EACH_LANE, [f"total = {total}", "alive = alive or math.isfinite(total)"]),
                block("if not alive:", ["break"]),
            ),
            *self._input_slopes(),
            *block("for step in range(n_steps):", self._stage_inputs(), self._all_lanes(paired)),
        ]
        sums = f"sums[j, l] = X[({self._sums} + j) * {LANES} + l]"
        body = [
            "wide_vectors()",
            "n_samples = u.shape[0]",
            "h = dt / n_steps",
            *STEP_SIZES,
            *self._begin(),
            *block("for k in range(n_samples):", sample),
            *block(f"for j in range({2 * q}):", block(EACH_LANE, [sums])),
        ]
        head = "def simulate(X, rows, tables, u, y, w, start, p, dt, n_steps, sums, record):"
        return "\n".join(block(head, body))

    def _begin(self) -> list[str]:
        """All lanes before the first sample."""
        lane = [
            f"c = constants({listed(f'p[{i}, l]' for i in range(self.n_parameters))})",
            *[f"{at(self.n_states + i)} = c[{i}]" for i in range(self.n_constants)],
            *[f"{at(i)} = start[{i}, l]" for i in range(self.n_states)],
            *[f"{at(self._sums + j)} = 0.0" for j in range(2 * self.n_outputs)],
            *self.fill(),
        ]
        lines = [f"A = zeros({len(self.closure)}, {LANES})", *block(EACH_LANE, lane)]
        if self.n_entries:
            lines.append(f"scheme_matrices(A, filled({LANES}, h), *tables, rows)")
        return lines

    def _all_lanes(self, paired: bool) -> list[str]:
        """One step of all lanes and their error estimates, as scalars of lane l."""
        lines = [
            *self._inputs_of_lane(),
            *[f"x{i} = {at(i)}" for i in range(self.n_states)],
            self._constants(),
            *self.slope("x", "ua", "m", "k"),
            *self.step(),
            *[f"{at(i)} = n{i}" for i in range(self.n_states)],
            *self._estimate(),
        ]
        if paired:
            return block(f"for l in range({LANES // 2}):", _paired(lines))
        return self._each_lane(lines)

    def _each_lane(self, *parts: Sequence[str]) -> list[str]:
        """What is done of every lane in turn."""
        return block(EACH_LANE, *parts)

    def _inputs_of_lane(self) -> list[str]:
        """Inputs that are lane l's, where not all have the same."""
        return []

    def _estimate(self) -> list[str]:
        """Add the step's error estimate, as it shows in the outputs, to the lane's sums."""
        lines = self.error_of_n() + self._shown(self.effects("t", self.structure.driven))
        if self.structure.guards:
            lines += self.slope("n", "uc", "mn", "kn")
            lines += [*self.margins("x", "ua", "q"), *self.margins("n", "uc", "r"), *self.missed()]
            lines += self._shown(self.effects("f", self.guarded))
        return lines

    def _shown(self, errors: Sequence[str]) -> list[str]:
        """Add to the lane's sums what errors of the states do to the outputs."""
        lines: list[str] = []
        shown: list[str] = []
        if self.output_states is not None:
            shown = [errors[i] for i in self.output_states]
        elif any(errors):
            exact = [f"n{i} - ({error})" if error else f"n{i}" for i, error in enumerate(errors)]
            lines += self.call("observe", "o", "n", "uc")
            lines += self.call("observe", "p", exact, "uc")
            shown = [f"o{j} - p{j}" for j in range(self.n_outputs)]
        for j, error in enumerate(shown):
            if error:
                lines += [f"e = {error}", f"{at(self._estimates + j)} += e * e"]
        return lines

    def _input_slopes(self) -> list[str]:
        """Change per step of the interpolated inputs in the interval from sample k."""
        lines = [f"i{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j in self.recorded_slopes]
        # Behind the inputs stand what squares and cubes count for in the splines (``bends``).
        for column, j in enumerate(self.splines):
            square = self.n_recorded + 2 * column
            lines += [f"square{j} = u[k, {square}]", f"cube{j} = u[k, {square + 1}]"]
        return lines

    def _stage_inputs(self) -> list[str]:
        """Inputs at the start (a), middle (b) and end (c) of a step."""
        lines = self.stage_inputs("step")
        if self.splines:
            lines += [f"r{stage} = (step + {part}) / n_steps" for stage, part in _STAGES.items()]
        for j in self.splines:
            for stage in _STAGES:
                away = f"r{stage} * (r{stage} - 1.0)"
                lines.append(f"u{stage}{j} += {away} * (square{j} + cube{j} * (r{stage} + 1.0))")
        return lines

    def _outputs(self) -> list[str]:
        """Lines that set the outputs o from lane l's state."""
        if self.output_states is not None:
            return [f"o{j} = {at(i)}" for j, i in enumerate(self.output_states)]
        states = [at(i) for i in range(self.n_states)]
        return [self._constants(), *self.call("observe", "o", states, "v")]

    def _spectrum(self) -> str:
        """Bound on the fastest rate of N, also beyond limits that no output would show."""
        # Other rows of its Jacobian are zero: the eigenvalues are those of the driven block.
        n = len(self.structure.driven)
        head = "def spectrum(u, x, p, rate):"
        if not n:
            return "\n".join(block(head, ["pass"]))
        finite = " and ".join(f"math.isfinite(X[{i}])" for i in range(self.n_states))
        at_sample = [
            *[f"X[{i}] = x[k, {i}, l]" for i in range(self.n_states)],
            *block(f"if not ({finite}):", ["continue"]),
            *self._jacobian(),
            "rate[l] = max(rate[l], fastest_rate(J, T))",
        ]
        lane = [
            f"c = constants({listed(f'p[{i}, l]' for i in range(self.n_parameters))})",
            *[f"rate[l] = max(rate[l], abs({text}))" for text in self._hidden_limits()],
            *block("for k in range(u.shape[0]):", at_sample),
        ]
        body = [
            f"J = zeros({n}, {n})",
            f"T = zeros({n}, {n})",
            f"X = filled({self.n_states}, 0.0)",
            f"N = filled({n}, 0.0)",
            *block("for l in range(rate.shape[0]):", lane),
        ]
        return "\n".join(block(head, body))

    def _hidden_limits(self) -> list[str]:
        """What a limited state's straight piece makes of itself in its own row.

        Beyond a limit N takes the straight piece back, as fast as A has it. Where an output shows
        the state the error estimate sees that; an error in a hidden one only adds up.
        """
        return [
            f"({gain}) * ({guard.slopes[row]})"
            for guard in self.structure.guards
            for row, gain in guard.gains.items()
            if row in guard.slopes and row not in self.structure.shown
        ]

    def _jacobian(self) -> list[str]:
        """J of the driven rows and columns of N beside X, by differences.

        Beside, because what switches most often does so where a model starts: dry friction at
        rest. A difference across the switch would be taken for an endlessly fast rate. And by
        more than the differences: the flow through an orifice is endlessly steep at rest only.
        """
        rows = self.structure.driven
        x = [f"X[{i}]" for i in range(self.n_states)]
        u = [f"u[k, {j}]" for j in range(self.n_inputs)]
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
                self.call("remainder", "a", x, u),
                block("if j < 0:", [f"N[{i}] = a{row}" for i, row in enumerate(rows)]),
                block("else:", ["X[q] = kept"], difference),
            ),
        ]


def at(row: int) -> str:
    """Lane l in a row of the work area."""
    return f"X[{row * LANES} + l]"


def residuals_kept(count: int, first: int) -> list[str]:
    """Rows of the work area from the first on, as many as outputs, kept as those of sample k."""
    return [f"copy_row(record, k * {count} + {j}, X, {first + j})" for j in range(count)]


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
