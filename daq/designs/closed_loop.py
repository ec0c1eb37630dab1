"""Runs in closed loop on a plant that is only computed: what a protocol's controller commands."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from daq.errors import USER_CODE_ERRORS, ConfigError, RigError, RunError
from daq.experiment import ClosedLoop, Plan, Sample
from daq.hal import CHANNELS, FloatArray
from daq.run.protocol import Dialogue, failure
from sysid import Feedback, ProcessModel, Stepper
from sysid.experiments.feedback import Answer

COMMANDS = tuple(f"applied_voltage_{name}" for name in CHANNELS)
MEASURED = ("current_motor", "current_brake", "torque", "theta", "omega")
_THETA = MEASURED.index("theta")


def places_of_commands(plant: ProcessModel) -> list[int]:
    """Places of ``COMMANDS`` among a plant's inputs."""
    return [plant.input_names.index(name) for name in COMMANDS]


def feedback_of(experiment: ClosedLoop, planned: Plan) -> Feedback:
    """Commands (2,) [V] of an experiment's controller that answer what is ``MEASURED``, (5,).

    A run raises RunError where the controller ends it in an emergency, ConfigError for mistakes of
    the protocol's code.
    """
    return Feedback(lambda: _Answers(experiment, planned), planned.n_samples, experiment.ahead)


class _Answers:
    """A new controller, asked for one sample after the other."""

    def __init__(self, experiment: ClosedLoop, planned: Plan) -> None:
        self._experiment, self._dialogue = experiment, Dialogue(experiment, planned)
        self._dt, self._tick = 1.0 / experiment.sample_rate, 0

    def __call__(self, measured: FloatArray) -> FloatArray | None:
        current_motor, current_brake, torque, theta, omega = measured.tolist()
        time = self._tick * self._dt
        sample = Sample(self._tick, time, current_motor, current_brake, torque, theta, omega, 0)
        self._tick += 1
        try:
            answer = self._dialogue.answer(sample)
        except RigError:
            raise
        except USER_CODE_ERRORS as error:
            text = failure(self._experiment, f"at simulated sample {sample.tick}", error)
            raise ConfigError(text) from error
        return None if answer is None else np.array([answer.motor, answer.brake])


@dataclass(frozen=True)
class ClosedLoopRun:
    """A run in closed loop: its commands, (n_samples, 2) [V], and the plant's outputs by name.

    Outputs are (1, n_samples) each.
    """

    commands: FloatArray
    signals: Mapping[str, FloatArray]


def play(
    feedback: Feedback, plant: ProcessModel, parameters: FloatArray, dt: float, count: float
) -> ClosedLoopRun | None:
    """A run of a plant; None where its controller ends it in an emergency, or it blows up.

    feedback: as of ``feedback_of``. parameters: of the plant. count: angle of one of the encoder
    [rad]; the controller sees whole ones.
    """
    sensed = _Sensed(plant, count)
    closed = replace(feedback, begin=lambda: sensed.controller(feedback))
    try:
        inputs, outputs = closed.run(Stepper(plant, parameters, dt))
    except RunError:
        return None
    signals = {name: outputs[None, :, j] for j, name in enumerate(plant.output_names)}
    return ClosedLoopRun(inputs[:, sensed.commanded], signals)


class _Sensed:
    """A plant as a rig's sensors show it; what it does not have is zero."""

    def __init__(self, plant: ProcessModel, count: float) -> None:
        names, self._count = plant.output_names, count
        self._places = [names.index(name) if name in names else len(names) for name in MEASURED]
        self.commanded = places_of_commands(plant)
        self._n_inputs = len(plant.inputs)

    def controller(self, feedback: Feedback) -> Answer:
        """A new controller, of the plant's outputs."""
        answer, inputs = feedback.begin(), np.zeros(self._n_inputs)

        def of_plant(outputs: FloatArray) -> FloatArray | None:
            commands = answer(self._measured(outputs))
            if commands is None:
                return None
            inputs[self.commanded] = commands
            return inputs

        return of_plant

    def _measured(self, outputs: FloatArray) -> FloatArray:
        values = [*outputs.tolist(), 0.0]
        if not math.isfinite(sum(values)):
            raise RunError("the simulated plant has no finite state")
        measured = [values[place] for place in self._places]
        measured[_THETA] = self._count * math.floor(measured[_THETA] / self._count)
        return np.array(measured)
