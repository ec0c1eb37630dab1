"""The run phase in closed loop: a controller answers every sample with a command."""

from dataclasses import dataclass

import numpy as np

from daq.errors import USER_CODE_ERRORS, RigError, RunError
from daq.experiment import Answer, ClosedLoop, Plan, Sample
from daq.hal import CHANNELS, FloatArray, Mode, Samples
from daq.logs.writer import LogWriter
from daq.run.protocol import AnswerCheck, controller_of, failure
from daq.run.sampling import Sampling, before


@dataclass(frozen=True)
class Answers:
    """Answers to n samples: commands (n, 2) [V], logged columns (n,) each; end: tick after them."""

    commands: FloatArray
    logged: list[FloatArray]
    end: int


class Dialogue:
    """A protocol's controller, asked for one sample after the other.

    ended: whether it has given its last answer. ahead: ticks from a sample to its command.
    """

    def __init__(self, experiment: ClosedLoop, planned: Plan) -> None:
        self.ahead = experiment.ahead
        self.ended = False
        self._experiment = experiment
        self._columns = tuple(experiment.columns)
        self._controller = controller_of(experiment)
        self._check = AnswerCheck(experiment, planned)
        self._last = Answer(0.0, 0.0, (0.0,) * len(self._columns))

    def answers(self, samples: Samples) -> Answers:
        """Answers to a block of samples, the last one zero commands once it has ended."""
        rows: list[Answer] = []
        columns = [getattr(samples, name).tolist() for name in Sample._fields]
        for values in zip(*columns, strict=True):
            answer = self._answer(Sample(*values))
            if answer is None:
                self.ended = True
                rows.append(Answer(0.0, 0.0, self._last.logged))
                break
            self._last = answer
            rows.append(answer)
        try:
            commands = np.array([(row.motor, row.brake) for row in rows], dtype=np.float64)
            logged = np.array([row.logged for row in rows], dtype=np.float64)
            logged = logged.reshape(len(rows), len(self._columns))
        except (TypeError, ValueError) as error:
            raise self._failed(samples.tick.item(0), error) from error
        return Answers(commands, list(logged.T), samples.tick.item(len(rows) - 1) + 1)

    def _answer(self, sample: Sample) -> Answer | None:
        try:
            answer = self._controller.answer(sample)
            if answer is not None:
                self._check(answer)
        except RigError:
            raise
        except USER_CODE_ERRORS as error:
            raise self._failed(sample.tick, error) from error
        return answer

    def _failed(self, tick: int, error: BaseException) -> RunError:
        text = failure(self._experiment, f"at sample {tick}", error)
        return RunError(f"{text}; outputs were set to zero")


def control(sampling: Sampling, log: LogWriter, dialogue: Dialogue, n_samples: int) -> None:
    """Answer and log every sample until the controller has ended, ``n_samples`` at the most."""
    rig, ahead = sampling.rig, dialogue.ahead
    sampling.begin(Mode.CLOSED_LOOP)
    rig.send(0, np.zeros((ahead, len(CHANNELS))))
    sent, done = ahead, 0
    while done < n_samples and not dialogue.ended:
        samples, trip = sampling.receive(n_samples)
        if len(samples) == 0:
            break
        answers = dialogue.answers(samples)
        if trip is None and not dialogue.ended:
            until = samples.tick.item(-1) + 1 + ahead
            commands = answers.commands
            if until - sent != len(commands):
                # A lost sample has no answer: the one after it serves its tick too.
                ticks = np.arange(sent, until)
                commands = commands[np.searchsorted(samples.tick + ahead, ticks)]
            rig.send(sent, commands)
            sampling.timing.answered(samples.tick.item(-1))
            sent = until
        done = sampling.keep(log, before(samples, answers.end), answers.logged, trip, n_samples)
    rig.stop()
