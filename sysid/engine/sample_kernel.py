"""Source text of kernels that advance lanes of one model sample by sample.

As the batch kernel's, but each lane has inputs of its own, which whoever closes a loop around it
knows only when the sample before is over.
"""

from sysid.engine.batch_kernel import BatchKernel
from sysid.engine.program import block
from sysid.engine.scheme import LANES, STEP_SIZES


class SampleKernel(BatchKernel):
    """Text of ``prepare``, once for lanes of parameters, and of ``advance``, over one sample.

    They need what the batch kernel's text needs. U holds rows of lanes: the inputs at the sample,
    then by how much each of ``interpolated`` changes until the next. h: of a step [s].
    """

    @property
    def input_rows(self) -> int:
        """Rows of lanes in U."""
        return self.n_inputs + len(self.interpolated)

    def text(self, *, many_registers: bool) -> str:
        """Python text of both."""
        prepare = block(
            "def prepare(X, rows, tables, start, p, h):", ["wide_vectors()", *self._begin()]
        )
        lanes = self._all_lanes(many_registers or bool(self.structure.coefficients))
        steps = block("for step in range(n_steps):", lanes)
        head = ["wide_vectors()", "share = 1.0 / n_steps", *STEP_SIZES]
        return "\n\n".join("\n".join(lines) for lines in (prepare, self._advance(head, steps)))

    def _advance(self, head: list[str], steps: list[str]) -> list[str]:
        return block("def advance(X, U, h, n_steps):", head, steps)

    def _inputs_of_lane(self) -> list[str]:
        lines = [f"v{j} = {input_at(j)}" for j in range(self.n_inputs)]
        changes = enumerate(self.interpolated, self.n_inputs)
        lines += [f"i{j} = share * {input_at(row)}" for row, j in changes]
        return lines + self.stage_inputs("step")

    def _estimate(self) -> list[str]:
        return []


class IntervalKernel(SampleKernel):
    """The same with an ``advance`` over many samples, in a row or each by itself.

    inputs: (n_samples, size of U). starts: states, (n, n_states * LANES), of the first n samples;
    each sample behind them begins where the one before it ended. ends: (n_samples, n_states *
    LANES), to be filled.
    """

    def _advance(self, head: list[str], steps: list[str]) -> list[str]:
        every = f"for i in range({self.n_states * LANES}):"
        sample = [
            "U = inputs[k]",
            *block("if k < starts.shape[0]:", block(every, ["X[i] = starts[k, i]"])),
            *steps,
            *block(every, ["ends[k, i] = X[i]"]),
        ]
        samples = block("for k in range(inputs.shape[0]):", sample)
        return block("def advance(X, starts, inputs, h, n_steps, ends):", head, samples)


def input_at(row: int) -> str:
    """Lane l in a row of inputs."""
    return f"U[{row * LANES} + l]"
