"""Source text of kernels that advance lanes of one model sample by sample.

As the batch kernel's, but each lane has inputs of its own, which whoever closes a loop around it
knows only when the sample before is over.
"""

from sysid.engine.batch_kernel import BatchKernel, at
from sysid.engine.program import block
from sysid.engine.scheme import LANES, STEP_SIZES
from sysid.engine.structure import Structure
from sysid.problem.model import ProcessModel


class SampleKernel(BatchKernel):
    """Text of ``prepare``, once for lanes of parameters, and of ``advance``, over one sample.

    They need what the batch kernel's text needs. U holds rows of lanes: the inputs at the sample,
    then by how much each of ``interpolated`` changes until the next. h: of a step [s]. The lanes
    read them behind the work area's rows: of another array LLVM would have to make sure that the
    states do not overlap it, and would leave a step as scalar code.
    """

    def __init__(self, model: ProcessModel, structure: Structure) -> None:
        super().__init__(model, structure)
        self._inputs = self.work_rows
        self.work_rows += self.input_rows

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
        return block("def advance(X, U, h, n_steps):", head, self._taken_over("U[i]"), steps)

    def _taken_over(self, inputs: str) -> list[str]:
        """Inputs, by place i, copied into the work area."""
        first = self._inputs * LANES
        return block(f"for i in range({self.input_rows * LANES}):", [f"X[{first} + i] = {inputs}"])

    def _input_of_lane(self, row: int) -> str:
        return at(self._inputs + row)

    def _inputs_of_lane(self) -> list[str]:
        lines = [f"v{j} = {self._input_of_lane(j)}" for j in range(self.n_inputs)]
        changes = enumerate(self.interpolated, self.n_inputs)
        lines += [f"i{j} = share * {self._input_of_lane(row)}" for row, j in changes]
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
            *self._taken_over("inputs[k, i]"),
            *block("if k < starts.shape[0]:", block(every, ["X[i] = starts[k, i]"])),
            *steps,
            *block(every, ["ends[k, i] = X[i]"]),
        ]
        samples = block("for k in range(inputs.shape[0]):", sample)
        return block("def advance(X, starts, inputs, h, n_steps, ends):", head, samples)
