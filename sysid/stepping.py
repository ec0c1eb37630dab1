"""One trajectory, advanced sample by sample: what a simulated rig needs."""

from __future__ import annotations

import math

import numpy as np

from sysid._compile import kernels
from sysid.model import FloatArray, ModelError, ProcessModel

_STEP_LIMIT = 0.3
_LEAST_STEPS = 16


class Stepper:
    """Advances the state of one model with one parameter vector.

    dt: sample time [s]. n_steps: integration steps per sample; default from the model's fastest
    rate at its initial state, fine enough for about 1e-5 of normalised error.
    """

    def __init__(
        self, model: ProcessModel, parameters: FloatArray, dt: float, n_steps: int | None = None
    ) -> None:
        if len(parameters) != len(model.parameters):
            raise ModelError(
                f"model {model.name} has {len(model.parameters)} parameters, not {len(parameters)}"
            )
        self.model = model
        self.parameters = np.ascontiguousarray(parameters, dtype=np.float64)
        self.dt = dt
        self._kernels = kernels(model)
        self.n_steps = n_steps or self._enough_steps()

    def advance(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Move the state x (n_states,), in place, over the intervals between the rows of u.

        u: (n + 1, n_inputs), the inputs at n + 1 sample instants; held inputs use the earlier
        row of each interval. Returns the states at the start of every integration step,
        (n * n_steps, n_states), and the outputs at the start of every interval,
        (n, n_outputs).
        """
        n = len(u) - 1
        trace = np.empty((n * self.n_steps, len(x)))
        outputs = np.empty((n, len(self.model.outputs)))
        self._kernels.advance(
            np.empty(self._kernels.work_size),
            self._kernels.triples,
            np.ascontiguousarray(u),
            x,
            self.parameters,
            self.dt,
            self.n_steps,
            trace,
            outputs,
        )
        return trace, outputs

    def _enough_steps(self) -> int:
        rate = np.zeros(1)
        self._kernels.spectrum(
            np.zeros((1, len(self.model.inputs))),
            self.model.initial_state[None, :, None],
            self.parameters[:, None],
            rate,
        )
        # A linear model is exact in one step; else fast linear parts feed the nonlinear one.
        least = 1 if self._kernels.fewest_steps == 1 else _LEAST_STEPS
        return max(least, math.ceil(float(rate[0]) * self.dt / _STEP_LIMIT))
