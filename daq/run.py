"""The run loop: open, calibrate, home, excite, make safe, close, logging every sample."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from daq.capture import COMPLETED, Capture
from daq.config.rig import RigConfig
from daq.errors import ConfigError, DeviceError, InterlockError, RigError, RunError, Terminated
from daq.experiment import Answer, ClosedLoop, Controller, Experiment, Plan, Sample
from daq.hal import CHANNELS, Device, Flag, FloatArray, Mode, Phase, Samples
from daq.log import LogWriter
from daq.rig import Rig, interlock_reason, mark_interlock

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
    """A completed run: its folder, what was logged, and what was noticed."""

    folder: Path
    n_samples: int
    timing: dict[str, Any]


Watcher = Callable[[PhaseProgress], None]


@dataclass
class _Timing:
    """Statistics of the run phase, for run.json."""

    started: float = field(default_factory=time.perf_counter)
    blocks: int = 0
    longest_gap: float = 0.0
    flags: dict[str, int] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def block(self, samples: Samples) -> None:
        now = time.perf_counter()
        self.longest_gap = max(self.longest_gap, now - self._last)
        self._last = now
        self.blocks += 1
        for flag in Flag:
            count = int(np.count_nonzero(samples.flags & int(flag)))
            if count:
                name = str(flag.name).lower()
                self.flags[name] = self.flags.get(name, 0) + count

    def summary(self) -> dict[str, Any]:
        return {
            "wall_seconds": round(time.perf_counter() - self.started, 6),
            "blocks": self.blocks,
            "longest_wait_seconds": round(self.longest_gap, 6),
            "flagged_samples": self.flags,
        }


def plan(experiment: Experiment, rig: RigConfig) -> Plan:
    """What a run will do, checked against the rig's limits.

    Raises ConfigError, before anything is energised, for settings that make no run or commands
    that the rig would clamp.
    """
    try:
        planned = experiment.plan()
    except ValueError as error:
        raise ConfigError(str(error)) from None
    for channel, name in enumerate(CHANNELS):
        least, most = getattr(rig.limits.command, name)
        low, high = planned.lowest[channel], planned.highest[channel]
        if low < least or high > most:
            beyond, where = (high, np.argmax) if high > most else (low, np.argmin)
            asked = f"up to {beyond:.6g} V"
            if planned.commands is not None:
                asked = f"for {beyond:.6g} V in sample {where(planned.commands[:, channel])}"
            raise ConfigError(
                f"{name}: the plan asks {asked}, outside the rig's limits "
                f"[{least:g}, {most:g}] V; change amplitude or offset, or "
                f"limits.command.{name} in the rig's file if the hardware allows it"
            )
    return planned


def run_experiment(
    experiment: Experiment,
    name: str,
    rig_config: RigConfig,
    device: Device,
    root: Path,
    watch: Watcher = lambda progress: None,
) -> RunResult:
    """Run an experiment on a device and log it under ``root``.

    Whatever ends it, both outputs are zeroed first and the capture folder says why. Raises
    ConfigError before energising; DeviceError, InterlockError, RunError, KeyboardInterrupt or
    Terminated afterwards.
    """
    planned = plan(experiment, rig_config)
    capture = Capture.create(
        root,
        name,
        {"experiment": experiment.describe(), "rig": rig_config.model_dump(mode="json")},
    )
    run = _Run(experiment, planned, Rig(device, rig_config), capture, watch)
    with _signals_raise():
        return run.execute()


@contextlib.contextmanager
def _signals_raise() -> Iterator[None]:
    """SIGTERM and SIGHUP end the run as Ctrl-C does: by an exception, past every ``finally``."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated(signal.Signals(number).name)

    # A closed terminal sends SIGHUP, where there is such a signal.
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = [(number, signal.signal(number, terminate)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


class _Run:
    """One run through its phases."""

    def __init__(
        self,
        experiment: Experiment,
        planned: Plan,
        rig: Rig,
        capture: Capture,
        watch: Watcher,
    ) -> None:
        self.experiment = experiment
        self.plan = planned
        self.rig = rig
        self.capture = capture
        self.watch = watch
        self.phase = Phase.OPEN
        self.timing = _Timing()

    def execute(self) -> RunResult:
        """All phases; the record in the capture folder names how they ended."""
        try:
            with LogWriter(self.capture.log_path, self._columns) as log:
                self._phases(log)
        except (RigError, KeyboardInterrupt, Terminated) as error:
            self._finish(*_outcome(error, self.phase))
            raise
        except Exception as error:
            reason = (
                f"the backend failed during {self.phase.value}: {type(error).__name__}: {error}; "
                "outputs were set to zero. Mend the backend, or report this to who maintains it"
            )
            self._finish("failed", reason)
            raise DeviceError(reason) from error
        self._finish(COMPLETED, None)
        return RunResult(self.capture.folder, log.n_samples, self.capture.record["timing"])

    def _phases(self, log: LogWriter) -> None:
        try:
            self._enter(Phase.OPEN)
            info = self.rig.open()
            self.capture.record["device"] = info.name
            self._enter(Phase.CALIBRATION)
            self._calibrate()
            if self.experiment.homing.turns > 0.0:
                self._enter(Phase.HOMING, self.experiment.homing.turns)
                self._home()
            self._enter(Phase.RUN)
            if isinstance(self.experiment, ClosedLoop):
                self._control(self.experiment, log)
            else:
                self._play(log)
            self._enter(Phase.SAFE)
        except BaseException:
            self.rig.safe()
            # A device that failed may fail to close as well; why it failed is what counts.
            with contextlib.suppress(DeviceError):
                self.rig.close()
            raise
        self.rig.safe()
        self.phase = Phase.CLOSE
        self.rig.close()

    @property
    def _columns(self) -> tuple[str, ...]:
        """What the log holds beside the samples."""
        return tuple(self.experiment.columns) if isinstance(self.experiment, ClosedLoop) else ()

    def _enter(self, phase: Phase, turns: float = 0.0) -> None:
        self.phase = phase
        if phase is not Phase.OPEN:
            self.rig.announce(phase, turns)

    def _finish(self, status: str, reason: str | None) -> None:
        connection = self.rig.report()
        if connection:
            self.capture.record["connection"] = connection
        # A record that cannot be written (the disk is full) must not hide why the run ended;
        # the folder then still says "running", which a reader reports as interrupted.
        with contextlib.suppress(RigError):
            self.capture.finish(
                status, reason, phase=self.phase.value, timing=self.timing.summary()
            )

    def _calibrate(self) -> None:
        """Mean of the inputs at zero command becomes their offset."""
        wanted = self.experiment.calibration.samples
        blocks: list[Samples] = []

        def enough(samples: Samples) -> bool:
            blocks.append(samples)
            done = sum(len(block) for block in blocks)
            self.watch(PhaseProgress(Phase.CALIBRATION, min(done, wanted), wanted, "samples"))
            return done >= wanted

        self._stream_zeros(enough)
        read = {
            name: np.concatenate([getattr(block, name) for block in blocks])
            for name in ("current_motor", "current_brake", "torque")
        }
        means = {name: float(values.mean()) for name, values in read.items()}
        self.rig.take_offsets(means)
        # How far the offsets, and every later sample, may be trusted.
        self.capture.record["calibration"] = {
            "samples": len(read["torque"]),
            "noise": {name: float(values.std()) for name, values in read.items()},
        }
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
            self.watch(PhaseProgress(Phase.HOMING, min(done, homing.turns), homing.turns, "turns"))
            if abs(turns - calm_turns) > _REST_TURNS:
                calm_from, calm_turns = now, turns
            if done >= homing.turns and now - calm_from >= _REST_TIME:
                return True
            if now > homing.timeout:
                raise RunError(
                    f"homing: {done:.2f} of {homing.turns:g} turns were wound in "
                    f"{homing.timeout:g} s; wind the load and start again, or raise "
                    "homing.timeout in the experiment"
                )
            return False

        self._stream_zeros(wound)
        self.capture.record["homing"] = {"turns": calm_turns - (start or 0.0), "rate": rate}

    def _stream_zeros(self, enough: Callable[[Samples], bool]) -> None:
        """Sample at zero command until ``enough`` says so."""
        # Sent a little ahead: zeros are safe to hold, and the host need not hurry every tick.
        ahead = max(1, round(_ZEROS_AHEAD * self.experiment.sample_rate))
        self.rig.start(self.experiment.sample_rate, Mode.CLOSED_LOOP)
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
            samples = _first(self.rig.receive(), total)
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

    def _control(self, experiment: ClosedLoop, log: LogWriter) -> None:
        """Answer every sample with a command until the controller, or the plan, is at its end."""
        answering = _Answering(experiment)
        self._begin(Mode.CLOSED_LOOP)
        self.rig.send(0, np.zeros((experiment.ahead, len(CHANNELS))))
        asked, done = experiment.ahead, 0
        while done < self.plan.n_samples and not answering.ended:
            samples = _first(self.rig.receive(), self.plan.n_samples)
            if len(samples) == 0:
                break
            samples, trip = self._guarded(samples)
            answers = answering.to(samples)
            if trip is None and not answering.ended:
                # A lost sample has no answer: the one after it serves its tick too.
                ticks = np.arange(asked, int(samples.tick[-1]) + 1 + experiment.ahead)
                places = np.searchsorted(samples.tick + experiment.ahead, ticks)
                self.rig.send(asked, answers.commands[places])
                asked += len(ticks)
            done = self._keep(log, _first(samples, answers.end), answers.logged, trip)
        self.rig.stop()

    def _begin(self, mode: Mode) -> None:
        self.rig.start(self.experiment.sample_rate, mode)
        self.timing = _Timing()

    def _guarded(self, samples: Samples) -> tuple[Samples, str | None]:
        """The samples up to one beyond a limit, and why; the outputs are zero by then."""
        trip = interlock_reason(samples, self.rig.config)
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
        self.timing.block(samples)
        done = int(samples.tick[-1]) + 1
        self.watch(PhaseProgress(Phase.RUN, done, self.plan.n_samples, "samples"))
        if trip is not None:
            raise InterlockError(f"interlock in sample {done - 1}: {trip}; outputs are zero")
        return done

    def _check(self, samples: Samples) -> None:
        trip = interlock_reason(samples, self.rig.config)
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

    def __init__(self, experiment: ClosedLoop) -> None:
        self._experiment = experiment
        self._controller: Controller = experiment.controller()
        self._last = Answer(0.0, 0.0, (0.0,) * len(experiment.columns))
        self.ended = False

    def to(self, samples: Samples) -> _Answers:
        """Answers to some samples; ``ended`` once the controller has none."""
        rows: list[Answer] = []
        for values in zip(*(getattr(samples, name).tolist() for name in _SAMPLE), strict=True):
            answer = self._ask(Sample(*values))
            if answer is None:
                self.ended = True
                rows.append(Answer(0.0, 0.0, self._last.logged))
                break
            self._last = answer
            rows.append(answer)
        commands = np.array([(row.motor, row.brake) for row in rows], dtype=np.float64)
        logged = np.array([row.logged for row in rows], dtype=np.float64)
        logged = logged.reshape(len(rows), len(self._experiment.columns))
        return _Answers(commands, list(logged.T), int(samples.tick[len(rows) - 1]) + 1)

    def _ask(self, sample: Sample) -> Answer | None:
        try:
            return self._controller.answer(sample)
        except RigError:
            raise
        except Exception as error:
            raise RunError(
                f"the protocol {self._experiment.protocol!r} failed at sample {sample.tick}: "
                f"{type(error).__name__}: {error}; outputs were set to zero"
            ) from error


def _first(samples: Samples, end_tick: int) -> Samples:
    """The samples with ticks before ``end_tick``."""
    keep = samples.tick < end_tick
    if keep.all():
        return samples
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
