"""Runs in closed loop: inputs that answer what is measured."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.stepper import Stepper
from sysid.problem.model import ModelError

# The inputs, (n_inputs,), that answer the outputs of a sample, (n_outputs,); None ends the run.
Answer = Callable[[FloatArray], FloatArray | None]


@dataclass(frozen=True)
class Feedback:
    """A controller in the place of inputs that are known beforehand.

    begin: a new controller for each run. n_samples: the longest run. ahead: samples from one to the
    inputs that answer it; until the first answer they are zero.

    >>> from sysid.examples import lag
    >>> servo = Feedback(lambda: lambda outputs: 10.0 * (1.0 - outputs), n_samples=200)
    >>> inputs, outputs = servo.run(Stepper(lag(), np.array([1.0, 0.5]), dt=0.01))
    >>> inputs[:2, 0].tolist(), outputs[-1, 0].round(3).item()  # 10/11, by a gain of 10
    ([0.0, 10.0], 0.909)
    """

    begin: Callable[[], Answer]
    n_samples: int
    ahead: int = 1

    def run(self, stepper: Stepper) -> tuple[FloatArray, FloatArray]:
        """Inputs (n, n_inputs) and outputs (n, n_outputs) of a run, n at most ``n_samples``.

        Raises ModelError for inputs of another number, or that are not finite, and for a run of
        fewer than two samples.
        """
        model, answer = stepper.model, self.begin()
        state = model.initial_state.astype(np.float64)
        inputs = np.zeros((self.n_samples, len(model.inputs)))
        outputs = np.empty((self.n_samples, len(model.outputs)))
        held = np.zeros((2, len(model.inputs)))
        for k in range(self.n_samples):
            held[:] = inputs[k]
            outputs[k] = stepper.advance(state, held)[1][0]
            answered = answer(outputs[k])
            if answered is None:
                return _long_enough(inputs[: k + 1]), outputs[: k + 1]
            if k + self.ahead < self.n_samples:
                inputs[k + self.ahead] = _of_shape(answered, len(model.inputs))
        return inputs, outputs


def _of_shape(answered: FloatArray, n_inputs: int) -> FloatArray:
    values = np.asarray(answered, dtype=np.float64)
    if values.shape != (n_inputs,) or not math.isfinite(sum(values.tolist())):
        raise ModelError(
            f"the controller of a feedback answered {answered!r}; answer with {n_inputs} finite "
            "numbers, one for each input"
        )
    return values


def _long_enough(inputs: FloatArray) -> FloatArray:
    if len(inputs) < 2:
        raise ModelError("the controller of a feedback ended the run at its first sample")
    return inputs
