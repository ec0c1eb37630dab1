"""The run loop: open, calibrate, home, excite, make safe, close, logging every sample."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.rig import RigConfig
from daq.errors import USER_CODE_ERRORS, DeviceError, InterlockError, RigError, RunError, Terminated
from daq.experiment import (
    Answer,
    ClosedLoop,
    Experiment,
    OffsetCalibration,
    Plan,
    Sample,
)
from daq.hal import CHANNELS, Device, Flag, FloatArray, Mode, Phase, Samples
from daq.limits import Limits, mark_interlock
from daq.logs.capture import COMPLETED, Capture
from daq.logs.writer import LogWriter
from daq.rig import Rig
from daq.run.interruption import Stopping
from daq.run.plan import plan
from daq.run.protocol_calls import AnswerCheck, controller_of, description_of, mistake
from daq.run.realtime import RealTime
from daq.run.timing import Timing

_ZEROS_AHEAD = 0.05  # s of zero commands queued while waiting
_REST_TIME = 1.0  # s that the shaft must stand still to end homing
_REST_TURNS = 0.01  # turns it may creep meanwhile
_SAMPLE = Sample._fields


@dataclass(frozen=True)
class PhaseProgress:
    """What a watcher of a run is told: ``done`` of ``total`` in ``unit`` of a phase."""

    phase: Phase
    done: float
    total: float
    unit: str


@dataclass(frozen=True)
class RunResult:
    """A completed run: its folder, what was logged, and how punctual it was, as in run.json."""

    folder: Path
    n_samples: int
    timing: dict[str, Any]
    realtime: dict[str, Any]


Watcher = Callable[[PhaseProgress], None]


def _nobody(progress: PhaseProgress) -> None:
    """Who watches when nobody does."""


def run_experiment(
    experiment: Experiment,
    name: str,
    rig_config: RigConfig,
    device: Device,
    root: Path,
    watch: Watcher = _nobody,
) -> RunResult:
    """Run an experiment on a device and log it under ``root``.

    Whatever ends it, both outputs are zeroed first and the capture folder says why. Raises
    ConfigError before energising; DeviceError, InterlockError, RunError, KeyboardInterrupt or
    Terminated afterwards, with a note (``__notes__``) on the folder.
    """
    planned = plan(experiment, rig_config)
    described = description_of(experiment)
    answering = _Answering(experiment, planned) if isinstance(experiment, ClosedLoop) else None
    limits = Limits(rig_config)
    capture = Capture.create(
        root,
        name,
        {"experiment": described, "rig": rig_config.model_dump(mode="json")},
    )
    with Stopping() as stopping:
        rig = Rig(device, rig_config)
        run = _Run(experiment, planned, answering, rig, capture, limits, stopping, watch)
        return run.execute()


class _Run:
    """One run through its phases."""

    def __init__(
        self,
        experiment: Experiment,
        planned: Plan,
        answering: _Answering | None,
        rig: Rig,
        capture: Capture,
        limits: Limits,
        stopping: Stopping,
        watch: Watcher,
    ) -> None:
        self.experiment = experiment
        self.plan = planned
        self.answering = answering
        self.rig = rig
        self.capture = capture
        self.limits = limits
        self.stopping = stopping
        self.watch = watch
        self.phase = Phase.OPEN
        self.timing = Timing()
        self.realtime = RealTime()

    def execute(self) -> RunResult:
        """All phases; the record in the capture folder names how they ended."""
        log = None
        try:
            with LogWriter(self.capture.log_path, self._columns) as log:
                self._phases(log)
                log.require_there()
        except (RigError, KeyboardInterrupt, Terminated) as error:
            self._finish(*_outcome(error, self.phase))
            error.add_note(self._kept(log))
            raise
        except USER_CODE_ERRORS as error:
            reason = (
                f"the backend failed during {self.phase.value}: {type(error).__name__}: {error}; "
                "outputs were set to zero. Mend the backend, or report this to who maintains it"
            )
            self._finish("failed", reason)
            failed = DeviceError(reason)
            failed.add_note(self._kept(log))
            raise failed from error
        self._finish(COMPLETED, None)
        record = self.capture.record
        return RunResult(self.capture.folder, log.n_samples, record["timing"], record["realtime"])

    def _kept(self, log: LogWriter | None) -> str:
        """Where the record of a run is that ended early."""
        n = log.n_samples if log is not None else 0
        late = self.timing.flags.get("held", 0)
        punctual = f", {late} commands came too late" if late else ""
        folder = self.capture.folder
        return f"what was recorded until then: {folder} ({n} samples of the run{punctual})"

    def _phases(self, log: LogWriter) -> None:
        try:
            try:
                self._work(log)
            finally:
                # A signal between here and the shield raises: the outer try answers that.
                self.stopping.shield()
        except BaseException:
            self._leave()
            # A device that failed may fail to close as well; why it failed is what counts.
            broken = (Exception, KeyboardInterrupt, Terminated)
            with contextlib.suppress(*broken), self.stopping.breakable():
                self.rig.close()
            raise
        self._leave()
        self.phase = Phase.CLOSE
        with self.stopping.breakable():
            self.rig.close()

    def _work(self, log: LogWriter) -> None:
        self._enter(Phase.OPEN)
        info = self.rig.open()
        self.capture.record["device"] = info.name
        self._schedule(info.virtual_time)
        self._enter(Phase.CALIBRATION)
        self._calibrate()
        if self.experiment.homing.turns > 0.0:
            self._enter(Phase.HOMING, self.experiment.homing.turns)
            self._home()
        self._enter(Phase.RUN)
        if self.answering is not None:
            self._control(self.answering, log)
        else:
            self._play(log)
        self._enter(Phase.SAFE)

    def _leave(self) -> None:
        """Zero outputs, whatever came before; ordinary scheduling."""
        self.rig.safe()
        self.realtime.undo()

    def _schedule(self, virtual_time: bool) -> None:
        asked = self.rig.config.realtime
        # A clock that waits for the host needs no haste, and would starve the machine of it.
        self.realtime.begin("off" if virtual_time else asked)
        self.capture.record["realtime"] = {
            "asked": asked,
            "needed": not virtual_time,
            "granted": self.realtime.granted,
            "refused": self.realtime.refused,
        }

    @property
    def _columns(self) -> tuple[str, ...]:
        """What the log holds beside the samples."""
        return tuple(self.experiment.columns) if isinstance(self.experiment, ClosedLoop) else ()

    def _enter(self, phase: Phase, turns: float = 0.0) -> None:
        self.phase = phase
        if phase is not Phase.OPEN:
            self.rig.announce(phase, turns)

    def _finish(self, status: str, reason: str | None) -> None:
        # A backend that failed may fail to report as well.
        with contextlib.suppress(Exception):
            if connection := self.rig.report():
                self.capture.record["connection"] = connection
        # A record that cannot be written (the disk is full) must not hide why the run ended;
        # the folder then still says "running", which a reader reports as interrupted.
        with contextlib.suppress(RigError):
            self.capture.finish(
                status, reason, phase=self.phase.value, timing=self.timing.summary()
            )

    def _calibrate(self) -> None:
        """Mean of the inputs at zero command becomes their offset, of a rig that is at rest."""
        calibration = self.experiment.calibration
        wanted = calibration.samples
        blocks: list[Samples] = []
        done = 0

        def enough(samples: Samples) -> bool:
            nonlocal done
            blocks.append(samples)
            done += len(samples)
            self._tell(Phase.CALIBRATION, min(done, wanted), wanted, "samples")
            return done >= wanted

        self._stream_zeros(enough)
        read = {
            name: np.concatenate([getattr(block, name) for block in blocks])
            for name in ("current_motor", "current_brake", "torque", "theta")
        }
        moved = float(np.ptp(read.pop("theta"))) / (2.0 * np.pi)
        means = {name: float(values.mean()) for name, values in read.items()}
        # How far the offsets, and every later sample, may be trusted.
        self.capture.record["calibration"] = {
            "samples": len(read["torque"]),
            "noise": {name: float(values.std()) for name, values in read.items()},
            "turns": moved,
        }
        _require_rest(calibration, moved, means)
        self.rig.take_offsets(means)
        self.capture.record["offsets"] = {
            **means,
            "volts": self.rig.offsets.volts.tolist(),
        }

    def _home(self) -> None:
        """Wait until the load is wound and the shaft has come to rest."""
        homing = self.experiment.homing
        rate = self.experiment.sample_rate
        start: float | None = None
        calm_from, calm_turns = 0.0, 0.0

        def wound(samples: Samples) -> bool:
            nonlocal start, calm_from, calm_turns
            now = float(samples.time[-1])
            turns = float(samples.theta[-1]) / (2.0 * np.pi)
            start = turns if start is None else start
            done = abs(turns - start)
            self._tell(Phase.HOMING, min(done, homing.turns), homing.turns, "turns")
            if abs(turns - calm_turns) > _REST_TURNS:
                calm_from, calm_turns = now, turns
            if done >= homing.turns and now - calm_from >= _REST_TIME:
                return True
            if now > homing.timeout:
                still = "; the shaft did not stand still then" if done >= homing.turns else ""
                raise RunError(
                    f"{done:.2f} of {homing.turns:g} turns were wound in "
                    f"{homing.timeout:g} s{still}",
                    cure="wind the load, hold it until the run goes on and start again, or raise "
                    "homing.timeout in the experiment",
                    key="homing",
                )
            return False

        self._stream_zeros(wound)
        self.capture.record["homing"] = {"turns": calm_turns - (start or 0.0), "rate": rate}

    def _stream_zeros(self, enough: Callable[[Samples], bool]) -> None:
        """Sample at zero command until ``enough`` says so."""
        # Sent a little ahead: zeros are safe to hold, and the host need not hurry every tick.
        ahead = max(1, round(_ZEROS_AHEAD * self.experiment.sample_rate))
        self._begin(Mode.CLOSED_LOOP)
        self.rig.send(0, np.zeros((ahead, len(CHANNELS))))
        asked = ahead
        while True:
            samples = self.rig.receive()
            self._check(samples)
            if enough(samples):
                break
            missing = int(samples.tick[-1]) + 1 + ahead - asked
            if missing > 0:
                self.rig.send(asked, np.zeros((missing, len(CHANNELS))))
                asked += missing
        self.rig.stop()

    def _play(self, log: LogWriter) -> None:
        """Preload and play the waveform."""
        waveform = self.plan.commands
        assert waveform is not None
        total = len(waveform)
        self._begin(Mode.OPEN_LOOP)
        sent = done = 0
        while done < total:
            room = self.rig.room()
            if sent < total and room > 0:
                chunk = waveform[sent : sent + room]
                self.rig.send(sent, chunk)
                sent += len(chunk)
                if done:
                    self.timing.answered(done - 1)
            samples = _first(self._receive(), total)
            if len(samples) == 0:
                break  # the last samples of the run were lost
            samples, trip = self._guarded(samples)
            done = self._keep(log, samples, (), trip)
            if np.any(samples.flags & int(Flag.UNDERFLOW)):
                raise DeviceError(
                    f"the device ran out of commands by sample {done - 1} and made itself safe; "
                    "the host was too slow to refill it"
                )
        self.rig.stop()

    def _control(self, answering: _Answering, log: LogWriter) -> None:
        """Answer every sample with a command until the controller, or the plan, is at its end."""
        ahead = answering.ahead
        self._begin(Mode.CLOSED_LOOP)
        self.rig.send(0, np.zeros((ahead, len(CHANNELS))))
        asked, done = ahead, 0
        while done < self.plan.n_samples and not answering.ended:
            samples = _first(self._receive(), self.plan.n_samples)
            if len(samples) == 0:
                break
            samples, trip = self._guarded(samples)
            answers = answering.to(samples)
            if trip is None and not answering.ended:
                until = samples.tick.item(-1) + 1 + ahead
                commands = answers.commands
                if until - asked != len(commands):
                    # A lost sample has no answer: the one after it serves its tick too.
                    ticks = np.arange(asked, until)
                    commands = commands[np.searchsorted(samples.tick + ahead, ticks)]
                self.rig.send(asked, commands)
                self.timing.answered(samples.tick.item(-1))
                asked = until
            done = self._keep(log, _first(samples, answers.end), answers.logged, trip)
        self.rig.stop()

    def _begin(self, mode: Mode) -> None:
        rate = self.experiment.sample_rate
        self.limits.begin(self.phase, rate)
        self.rig.start(rate, mode, self.limits.window())
        self.timing = Timing()

    def _receive(self) -> Samples:
        samples = self.rig.receive()
        self.timing.received(samples)
        return samples

    def _tell(self, phase: Phase, done: float, total: float, unit: str) -> None:
        try:
            self.watch(PhaseProgress(phase, done, total, unit))
        except OSError:
            # Its terminal or pipe is gone. That is no reason to lose a run: whoever closed it
            # ends the run by a signal, if that was meant.
            self.watch = _nobody

    def _guarded(self, samples: Samples) -> tuple[Samples, str | None]:
        """The samples up to one beyond a limit, and why; the outputs are zero by then."""
        trip = self.limits.check(samples)
        if trip is None:
            return samples, None
        self.rig.safe()
        row, reason = trip
        return mark_interlock(_first(samples, int(samples.tick[row]) + 1), row), reason

    def _keep(
        self, log: LogWriter, samples: Samples, extra: Sequence[FloatArray], trip: str | None
    ) -> int:
        """Log samples, before the next wait; how far the run is. Raises InterlockError."""
        log.append(samples, extra)
        self.timing.logged(samples)
        done = int(samples.tick[-1]) + 1
        self._tell(Phase.RUN, done, self.plan.n_samples, "samples")
        if trip is not None:
            raise InterlockError(f"interlock in sample {done - 1}: {trip}; outputs are zero")
        return done

    def _check(self, samples: Samples) -> None:
        trip = self.limits.check(samples)
        if trip is not None:
            self.rig.safe()
            raise InterlockError(
                f"interlock during {self.phase.value}: {trip[1]}; outputs are zero"
            )


@dataclass(frozen=True)
class _Answers:
    """Answers to n samples: commands (n, 2) [V], logged values (n,) each; end: tick after them."""

    commands: FloatArray
    logged: list[FloatArray]
    end: int


class _Answering:
    """A controller asked for one sample after the other."""

    def __init__(self, experiment: ClosedLoop, planned: Plan) -> None:
        self.ahead = experiment.ahead
        self.ended = False
        self._experiment = experiment
        self._columns = tuple(experiment.columns)
        self._controller = controller_of(experiment)
        self._check = AnswerCheck(experiment, planned)
        self._last = Answer(0.0, 0.0, (0.0,) * len(self._columns))

    def to(self, samples: Samples) -> _Answers:
        """Answers to some samples; ``ended`` once the controller has none."""
        rows: list[Answer] = []
        for values in zip(*[getattr(samples, name).tolist() for name in _SAMPLE], strict=True):
            answer = self._ask(Sample(*values))
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
        return _Answers(commands, list(logged.T), int(samples.tick[len(rows) - 1]) + 1)

    def _ask(self, sample: Sample) -> Answer | None:
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
        reason = mistake(self._experiment, f"at sample {tick}", error)
        return RunError(f"{reason}; outputs were set to zero")


def _require_rest(calibration: OffsetCalibration, moved: float, means: dict[str, float]) -> None:
    """Raise RunError unless what was averaged was a rig at rest."""
    if moved > calibration.motion:
        raise RunError(
            f"the shaft moved by {moved:.3g} turns at zero command, more than calibration.motion "
            f"of {calibration.motion:g} turns",
            cure="let it come to rest, keep hands off and start again",
            key="calibration",
        )
    for name in ("current_motor", "current_brake"):
        most = getattr(calibration, name)
        if not abs(means[name]) <= most:
            raise RunError(
                f"{name} reads {means[name]:.4g} A at zero command, more than calibration.{name} "
                f"of {most:g} A: a current flows, or the sensor is far off. Look at the "
                "amplifier's input and its zero, and at the sensor's wires",
                cure=f"raise calibration.{name} in the experiment if it is the sensor's offset",
                key="calibration",
            )


def _first(samples: Samples, end_tick: int) -> Samples:
    """The samples with ticks before ``end_tick``."""
    if samples.tick.item(-1) < end_tick:
        return samples
    keep = samples.tick < end_tick
    return Samples(**{name: getattr(samples, name)[keep] for name in samples.__dataclass_fields__})


def _outcome(error: BaseException, phase: Phase) -> tuple[str, str]:
    """Status and reason that the capture folder keeps of an ended run."""
    where = f"during {phase.value}"
    if isinstance(error, KeyboardInterrupt):
        return "stopped", f"stopped by Ctrl-C {where}"
    if isinstance(error, Terminated):
        return "stopped", f"stopped by {error} {where}"
    if isinstance(error, InterlockError):
        return "interlock", str(error)
    return "failed", str(error)
