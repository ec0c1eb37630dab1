"""One trajectory, advanced sample by sample: what a simulated rig needs."""

import math
from collections.abc import Callable

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.compiler import explained_errors, kernels
from sysid.engine.scheme import work_area
from sysid.engine.trajectory_kernel import LEVELS
from sysid.problem.model import ModelError, ProcessModel

# Error estimate of one step, of all states together, in parts of what the trajectory's error may
# be. The largest error of the simulated rig is then between a half and twice what was asked for.
_ESTIMATE_LIMIT = 0.3


class Stepper:
    """Advances the state of one model with one parameter vector.

    dt: sample time [s]. n_steps: equal base steps per sample, each of which is halved as often
    as the accuracy asks for. accuracy: error, in parts of ``scale``, that the trajectory is to
    keep. scale: (n_states,), magnitudes that matter; default the larger of 1 and the state's
    initial value. Raises ModelError for settings that do not fit the model.

    >>> from sysid.examples import lag
    >>> stepper = Stepper(lag(), np.array([1.0, 0.05]), dt=0.05)
    >>> x = lag().initial_state
    >>> states, outputs = stepper.advance(x, np.ones((3, 1)))  # two intervals
    >>> outputs[:, 0].round(3).tolist(), x.round(3).tolist()
    ([0.0, 0.632], [0.865])
    """

    def __init__(
        self,
        model: ProcessModel,
        parameters: FloatArray,
        dt: float,
        *,
        n_steps: int = 4,
        scale: FloatArray | None = None,
        accuracy: float = 1e-5,
    ) -> None:
        self.parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        if self.parameters.shape != (len(model.parameters),):
            raise ModelError(
                f"model {model.name} has {len(model.parameters)} parameters, not {len(parameters)}"
            )
        if scale is None:
            scale = np.maximum(np.abs(model.initial_state), 1.0)
        self.scale = np.ascontiguousarray(scale, dtype=np.float64)
        if self.scale.shape != (len(model.states),) or not np.all(self.scale > 0.0):
            raise ModelError(f"scale must be {len(model.states)} positive numbers, not {scale}")
        if n_steps < 1:
            raise ModelError(f"n_steps is {n_steps}; it must be at least 1")
        if not 1e-12 <= accuracy <= 0.1:
            raise ModelError(f"accuracy {accuracy:g} is outside [1e-12, 0.1]")
        self.model = model
        self.dt = dt
        self.n_steps = n_steps
        self.accuracy = accuracy
        self._kernels = kernels(model)
        self._n_states, self._n_inputs = len(model.states), len(model.inputs)
        self._n_outputs = len(model.outputs)
        self._base = dt / n_steps
        self._limit = (_ESTIMATE_LIMIT * accuracy) ** 2
        self._work = work_area(self._kernels.trajectory.work_size)
        self._least = 0
        self._run: Callable[..., None] | None = None

    def advance(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Move the state x (n_states,), in place, over the intervals between the rows of u.

        u: (n + 1, n_inputs), the inputs at n + 1 sample instants; held inputs use the earlier
        row of each interval. Returns the states at the start of every base step,
        (n * n_steps, n_states), and the outputs at the start of every interval,
        (n, n_outputs).
        """
        n = len(u) - 1
        if len(x) != self._n_states or u.shape[1] != self._n_inputs:
            raise ModelError(
                f"model {self.model.name} has {self._n_states} states and {self._n_inputs} "
                f"inputs; arrays of shape {x.shape} and {u.shape} were given"
            )
        trace = np.empty((n * self.n_steps, self._n_states))
        outputs = np.empty((n, self._n_outputs))
        if not (u.flags.c_contiguous and u.dtype == np.float64):
            u = np.ascontiguousarray(u, dtype=np.float64)
        run = self._run or self._prepare(x, u)
        run(self._work, u, x, self._base, self.n_steps, self._least, self._limit, trace, outputs)
        return trace, outputs

    def _prepare(self, x: FloatArray, u: FloatArray) -> Callable[..., None]:
        """Fill the work area, once for all runs, and compile what advances."""
        n = len(x)
        a = np.zeros((n, n))
        compiled, work, base = self._kernels, self._work, self._base
        with explained_errors(self.model):
            compiled.levels(work, compiled.trajectory.tables, self.parameters, self.scale, base, a)
            if compiled.trajectory.structure.guards and np.isfinite(a).all():
                periods = np.abs(np.linalg.eigvals(a)).max() * base / (2.0 * math.pi)
                self._least = min(math.ceil(math.log2(max(periods, 1.0))), LEVELS)
            # A call over no interval, to compile.
            nothing = np.empty((0, n)), np.empty((0, self._n_outputs))
            compiled.advance(work, u[:1], x, base, self.n_steps, self._least, self._limit, *nothing)
        self._run = compiled.advance
        return self._run
