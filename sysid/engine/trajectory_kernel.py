"""Source text of the kernels that advance one trajectory, with steps halved where it is needed.

Every sample interval is a number of equal base steps. A base step is taken whole, or in parts of
2^-level of it where the error estimate is too large; each level's matrices are stored once. A
level that was found is kept until a coarser one fits again, and forgotten at the end of the
interval: what happens in one depends on nothing but the state it starts from.

``least`` is the level that no step is coarser than: a swing of several periods within a step may
look the same at both its ends and in its middle, and run into limits in between.
"""

from sysid.engine.program import block, listed
from sysid.engine.scheme import LANES, STEP_SIZES, Scheme, numbered

LEVELS = 10

_WHOLE = 2**LEVELS
# The squared estimate falls with the sixth power of the step; half of what is allowed is left
# as a margin, so that a coarser step is seldom tried in vain.
_COARSER = 2.0**-7


class TrajectoryKernel(Scheme):
    """Text of the kernels of one trajectory; needs math, scheme_matrices, ``parts`` and the
    program.

    ``levels`` fills a work area once per parameter vector, ``advance`` uses it.
    """

    def text(self) -> str:
        """Python text of both."""
        return "\n\n".join((self._levels(), self._advance(), ""))

    @property
    def work_size(self) -> int:
        """Floats in the work area: constants, inverse magnitudes, each level's matrices."""
        return self.n_constants + self.n_states + (LEVELS + 1) * self.n_entries

    def _place(self, entry: int) -> str:
        return f"X[first + {entry}]"

    def _levels(self) -> str:
        """Fill the work area, and A; each level is a lane while its matrices are made."""
        n, entries = self.n_constants, self.n_entries
        body = [
            f"c = constants({listed(f'p[{i}]' for i in range(self.n_parameters))})",
            *[f"X[{i}] = c[{i}]" for i in range(n)],
            *block(f"for i in range({self.n_states}):", [f"X[{n} + i] = 1.0 / scale[i]"]),
            *[f"a[{i}, {j}] = {text}" for (i, j), text in self.structure.coefficients.items()],
        ]
        if entries:
            each = f"for l in range({LEVELS + 1}):"
            stored = f"X[{n + self.n_states} + l * {entries} + k] = rows[k, l]"
            body += [
                f"A = zeros({len(self.closure)}, {LANES})",
                f"H = filled({LANES}, 0.0)",
                f"rows = zeros({entries}, {LANES})",
                *block(each, ["H[l] = h * 0.5 ** l"], self.fill()),
                "scheme_matrices(A, H, *tables, rows)",
                *block(each, block(f"for k in range({entries}):", [stored])),
            ]
        return "\n".join(block("def levels(X, tables, p, scale, h, a):", body))

    def _advance(self) -> str:
        n, inputs = self.n_states, range(self.n_inputs)
        base_step = [
            *[f"trace[k * n_steps + step, {i}] = x{i}" for i in range(n)],
            # What is not finite any more gets no better by halving.
            f"finite = math.isfinite({' + '.join(numbered('k', n))})",
            f"deepest = {LEVELS} if finite else least",
            "level = min(level, deepest)",
            "done = 0",
            *block(f"while done < {_WHOLE}:", self._part()),
        ]
        interval = [
            *[f"v{j} = u[k, {j}]" for j in inputs],
            *self._outputs(),
            *[f"i{j} = (u[k + 1, {j}] - v{j}) / n_steps" for j in self.interpolated],
            *self.slope("x", "v", "m", "k"),
            *self.margins("x", "v", "q"),
            "level = least",
            *block("for step in range(n_steps):", base_step),
        ]
        body = [
            f"c = {listed(f'X[{i}]' for i in range(self.n_constants))}",
            *[f"z{i} = X[{self.n_constants + i}]" for i in range(n)],
            *[f"x{i} = x[{i}]" for i in range(n)],
            *block("for k in range(u.shape[0] - 1):", interval),
            *[f"x[{i}] = x{i}" for i in range(n)],
        ]
        head = "def advance(X, u, x, base, n_steps, least, limit, trace, outputs):"
        return "\n".join(block(head, body))

    def _part(self) -> list[str]:
        """Try one part of a base step; take it where its error allows, or halve it."""
        n = self.n_states
        renamed = (("x", "n", n), ("m", "mn", n), ("k", "kn", n), ("q", "r", self.n_margins))
        coarser = f"if level > least and error <= {_COARSER!r} * limit and done % (2 * part) == 0:"
        taken = [
            *[f"{now}{i} = {new}{i}" for now, new, count in renamed for i in range(count)],
            "done += part",
            *block(coarser, ["level -= 1"]),
        ]
        return [
            f"part = {_WHOLE} >> level",
            f"share = part * {1.0 / _WHOLE!r}",
            "h = base * share",
            f"first = {self.n_constants + n} + level * {self.n_entries}",
            *STEP_SIZES,
            *self.stage_inputs(f"(step + done * {1.0 / _WHOLE!r})", "share * "),
            *self.step(),
            *self.slope("n", "uc", "mn", "kn"),
            *self.margins("n", "uc", "r"),
            *self._error(),
            *block("if error <= limit or level == deepest:", taken),
            *block("else:", ["level += 1"]),
        ]

    def _error(self) -> list[str]:
        """Sum of squares, over the states, of all that hints at an error of a step."""
        driven = self.structure.driven
        lines = self.error_of_n()
        # A relay that the first half of a step overshoots sends the stages to and fro, and cancels
        # from the estimate; the two stages at the middle of the step then differ.
        lines += [f"o{i} = db{i} - da{i}" for i in driven]
        lines += self.missed()
        squares = []
        for vector, rows in (("t", driven), ("o", driven), ("f", self.guarded)):
            for i, effect in enumerate(self.effects(vector, rows)):
                if effect:
                    lines.append(f"e{vector}{i} = ({effect}) * z{i}")
                    squares.append(f"e{vector}{i} * e{vector}{i}")
        return [*lines, f"error = {' + '.join(squares) or '0.0'}"]

    def _outputs(self) -> list[str]:
        """Lines that store the outputs at the start of interval k."""
        if self.output_states is not None:
            return [f"outputs[k, {j}] = x{i}" for j, i in enumerate(self.output_states)]
        lines = self.call("observe", "o", "x", "v")
        return lines + [f"outputs[k, {j}] = o{j}" for j in range(self.n_outputs)]
