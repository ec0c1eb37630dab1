"""The run loop: open, calibrate, home, excite, make safe, close, logging every sample."""

import contextlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from daq.config.rig import RigConfig
from daq.errors import (
    IncompleteError,
    InterlockError,
    RigError,
    RunError,
    Terminated,
    UnreachedError,
)
from daq.experiment import Aboard, ClosedLoop, Experiment, Plan
from daq.hal import ANALOG_INPUTS, Device, Phase
from daq.limits import Limits
from daq.limits.device import saturation_warnings
from daq.logs.capture import COMPLETED, INTERLOCK, RUNNING, Capture
from daq.logs.writer import LogWriter
from daq.rig import Rig
from daq.run.hang import HangGuard
from daq.run.outputs import INTERRUPTED, OutputState, read_back
from daq.run.phases import calibrate, control, home, play, require_law, supervise
from daq.run.plan import plan
from daq.run.protocol import Dialogue, aboard_of, description_of
from daq.run.realtime import RealTime
from daq.run.sampling import Sampling, Watcher, nobody
from daq.run.signals import SignalHandling
from daq.views import Lines, Shown

_BY_HAND = "hand (Ctrl-C, or Stop in the scope)"
_STATUS: dict[type[BaseException], str] = {
    InterlockError: INTERLOCK,
    IncompleteError: "incomplete",
}  # others: failed


@dataclass(frozen=True, repr=False)
class RunResult(Shown):
    """A completed run: its folder, what was logged, and how punctual it was, as in run.json.

    doubts: what the limits that do not stop a run have said, with the cures. warnings: the same of
    the device.
    """

    folder: Path
    n_samples: int
    timing: dict[str, Any]
    realtime: dict[str, Any]
    doubts: list[str]
    warnings: list[str]

    @property
    def headline(self) -> str:
        """Its samples, where they are, and how much is in doubt."""
        doubts = f", {n} doubts" if (n := len(self.doubts) + len(self.warnings)) else ""
        return f"{self.n_samples} samples in {self.folder}{doubts}"

    def lines(self) -> Lines:
        """What was in doubt."""
        doubts = [*self.doubts, *self.warnings]
        return [["doubts"], *([text] for text in doubts)] if doubts else []

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        facts = {"timing": self.timing, "realtime": self.realtime, "doubts": self.doubts}
        return {"folder": str(self.folder), "samples": self.n_samples, **facts}


def run_experiment(
    experiment: Experiment,
    name: str,
    rig_config: RigConfig,
    device: Device,
    root: Path,
    watch: Watcher = nobody,
    rig_file: str = "",
) -> RunResult:
    """Run an experiment on a device and log it under ``root``.

    rig_file: which the configuration is of, as it is typed, for the record. Whatever ends it, both
    outputs are zeroed first and the capture folder says why. Raises ConfigError before energising;
    DeviceError, InterlockError, RunError, KeyboardInterrupt or Terminated afterwards, with a note
    (``__notes__``) on the folder.
    """
    planned = plan(experiment, rig_config)
    description = description_of(experiment)
    dialogue = Dialogue(experiment, planned) if isinstance(experiment, ClosedLoop) else None
    aboard = aboard_of(experiment)
    limits = Limits(rig_config)
    record = {
        "experiment": description,
        "rig_file": rig_file,
        "rig": rig_config.model_dump(mode="json"),
    }
    sampling = Sampling(Rig(device, rig_config), limits, experiment.sample_rate, watch)
    with SignalHandling() as signals:
        capture = Capture.create(root, name, record, experiment.metadata)
        realtime = RealTime(overrun=signals.end_by)
        parts = experiment, planned, dialogue, aboard, sampling, capture, signals, realtime
        return _Run(*parts).execute()


@dataclass
class _Run:
    """One run through its phases.

    dialogue: with the controller of a closed loop. aboard: what the device's own controller is
    asked for, where that closes the loop. outputs: as they were at the end of a run whose
    rig was opened.
    """

    experiment: Experiment
    plan: Plan
    dialogue: Dialogue | None
    aboard: Aboard | None
    sampling: Sampling
    capture: Capture
    signals: SignalHandling
    realtime: RealTime
    outputs: OutputState | None = None

    def execute(self) -> RunResult:
        """All phases; the record in the capture folder names how they ended."""
        log = None
        columns = self.experiment.columns if isinstance(self.experiment, ClosedLoop) else ()
        self.signals.last_act = self._give_up
        try:
            self.signals.release()
            with LogWriter(self.capture.log_path, tuple(columns), self.sampling.warn) as log:
                self._all_phases(log)
            log.require_whole()
        except (RigError, KeyboardInterrupt, Terminated) as error:
            self._finish_early(error, log)
            raise
        except BaseException as error:
            failed = RunError(
                f"the program failed during {self.sampling.phase.value}: "
                f"{type(error).__name__}: {error}",
                cure="report this to who maintains it",
            )
            self._finish_early(failed, log)
            raise failed from error
        self._finish(COMPLETED, None)
        record = self.capture.record
        doubts = [doubt.sentence for doubt in self.sampling.limits.doubts]
        warnings = [
            *record.get("connection", {}).get("warnings", []),
            *saturation_warnings(self.sampling.rig.saturated),
        ]
        facts = record["timing"], record["realtime"], doubts, warnings
        return RunResult(self.capture.folder, log.n_samples, *facts)

    def _all_phases(self, log: LogWriter) -> None:
        rig = self.sampling.rig
        try:
            with HangGuard(rig, self.signals, self.realtime, self.experiment.sample_rate):
                try:
                    try:
                        self._phases_under_power(log)
                    finally:
                        # A signal between here and the shield raises: the outer try answers that.
                        self.signals.shield()
                finally:
                    self._leave()
        except BaseException:
            # A device that failed may fail to close as well; why it failed is what counts.
            broken = (Exception, KeyboardInterrupt, Terminated)
            for step in (self._read_back, rig.close, self._report):
                with contextlib.suppress(*broken), self.signals.breakable():
                    step()
            raise
        self.sampling.phase = Phase.CLOSE
        with self.signals.breakable(), contextlib.ExitStack() as last_steps:
            last_steps.callback(self._report)
            last_steps.callback(rig.close)
            self._read_back()
        if self.outputs is not None and self.outputs.problem is not None:
            raise RunError(
                "all was recorded, but the outputs did not become zero as they must: "
                f"{self.outputs.problem}"
            )

    def _phases_under_power(self, log: LogWriter) -> None:
        sampling, record, homing = self.sampling, self.capture.record, self.experiment.homing
        info = sampling.rig.open()
        record["device"] = info.name
        if self.aboard is not None:
            require_law(sampling.rig, self.aboard.law)
        self._schedule(info.virtual_time)
        sampling.enter(Phase.CALIBRATION)
        calibrate(sampling, self.experiment.calibration, record)
        if homing.turns > 0.0:
            sampling.enter(Phase.HOMING, homing.turns)
            home(sampling, homing, record)
        sampling.enter(Phase.RUN)
        if self.aboard is not None:
            supervise(sampling, log, self.aboard)
        elif self.dialogue is not None:
            control(sampling, log, self.dialogue, self.plan.n_samples)
        elif self.plan.commands is not None:
            self.capture.record["planned"] = True  # no command answers a sample
            play(sampling, log, self.plan.commands)
        sampling.enter(Phase.SAFE)

    def _leave(self) -> None:
        """Zero outputs, whatever came before; ordinary scheduling."""
        # Behind the shield it is the backend's own doing if one of these is raised.
        with contextlib.suppress(KeyboardInterrupt, Terminated):
            self.sampling.rig.safe()
        self.realtime.undo()

    def _report(self) -> None:
        """Record what the device has to say."""
        if connection := self.sampling.rig.report():
            self.capture.record["connection"] = connection

    def _read_back(self) -> None:
        """Record whether the outputs of a rig that was opened are zero."""
        if "device" in self.capture.record:
            rate, calibration = self.experiment.sample_rate, self.experiment.calibration
            self.outputs = INTERRUPTED
            self.outputs = read_back(self.sampling.rig, rate, calibration)

    def _schedule(self, virtual_time: bool) -> None:
        wanted = self.sampling.rig.config.realtime
        # A clock that waits for the host needs no haste, and would starve the machine of it.
        self.realtime.begin("off" if virtual_time else wanted)
        self.capture.record["realtime"] = {
            "asked": wanted,
            "needed": not virtual_time,
            "granted": self.realtime.granted,
            "refused": self.realtime.refused,
        }

    def _finish_early(self, error: BaseException, log: LogWriter | None) -> None:
        """Record why the run ended, and note on the error where the record is."""
        status, reason = self._end(error)
        disturbance = log.disturbance if log is not None else None
        if disturbance is not None and disturbance not in reason:
            reason += f"; {self.capture.log_path.name}: {disturbance}"
            error.add_note(f"{self.capture.log_path}: {disturbance}")
        if isinstance(error, UnreachedError) and self.sampling.phase is Phase.OPEN:
            self.capture.discard()
            return
        self._finish(status, reason)
        if isinstance(error, KeyboardInterrupt):
            error.args = (_BY_HAND,)
        n = log.n_samples if log is not None else 0
        late = self.sampling.timing.flags.get("held", 0)
        punctuality = f", {late} commands came too late" if late else ""
        error.add_note(
            f"what was recorded so far: {self.capture.folder} ({n} samples of the run{punctuality})"
        )
        if self.outputs is not None:
            error.add_note(self.outputs.text)

    def _end(self, error: BaseException) -> tuple[str, str]:
        """Status and reason of a run that ended by an error."""
        where = f"during {self.sampling.phase.value}"
        if isinstance(error, KeyboardInterrupt):
            return "stopped", f"stopped by {_BY_HAND} {where}"
        if isinstance(error, Terminated):
            return "stopped", f"stopped by {error} {where}"
        return _STATUS.get(type(error), "failed"), str(error)

    def _give_up(self, status: str, reason: str) -> str:
        """The least record of a run that hangs, in the middle of whatever it does.

        What is to be said of its outputs.
        """
        record, phase = self.capture.record, self.sampling.phase.value
        outputs = self.outputs or OutputState(False, reason)
        record["outputs"] = outputs.document
        if record["status"] == RUNNING:
            record.update(status=status, reason=f"{reason}, during {phase}", phase=phase)
        with contextlib.suppress(RigError):
            self.capture.save()
        return outputs.text

    def _finish(self, status: str, reason: str | None) -> None:
        saturated = dict(zip(ANALOG_INPUTS, self.sampling.rig.saturated.tolist(), strict=True))
        self.capture.record["saturated_samples"] = saturated
        if self.outputs is not None:
            self.capture.record["outputs"] = self.outputs.document
        # A record that cannot be written (the disk is full) must not hide why the run ended;
        # the folder then still says "running", which a reader reports as interrupted.
        self.capture.record["doubts"] = [asdict(doubt) for doubt in self.sampling.limits.doubts]
        phase, timing = self.sampling.phase.value, self.sampling.timing.summary()
        with contextlib.suppress(RigError):
            self.capture.finish(status, reason, phase=phase, timing=timing)
