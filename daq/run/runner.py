"""The run loop: open, calibrate, home, excite, make safe, close, logging every sample."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.config.rig import RigConfig
from daq.errors import USER_CODE_ERRORS, DeviceError, InterlockError, RigError, Terminated
from daq.experiment import ClosedLoop, Experiment
from daq.hal import Device, FloatArray, Phase
from daq.limits import Limits
from daq.logs.capture import COMPLETED, Capture
from daq.logs.writer import LogWriter
from daq.rig import Rig
from daq.run.closed_loop import Dialogue, control
from daq.run.open_loop import play
from daq.run.plan import plan
from daq.run.preparation import calibrate, home
from daq.run.protocol import description_of
from daq.run.realtime import RealTime
from daq.run.sampling import Sampling, Watcher, nobody
from daq.run.signals import SignalHandling


@dataclass(frozen=True)
class RunResult:
    """A completed run: its folder, what was logged, and how punctual it was, as in run.json."""

    folder: Path
    n_samples: int
    timing: dict[str, Any]
    realtime: dict[str, Any]


def run_experiment(
    experiment: Experiment,
    name: str,
    rig_config: RigConfig,
    device: Device,
    root: Path,
    watch: Watcher = nobody,
) -> RunResult:
    """Run an experiment on a device and log it under ``root``.

    Whatever ends it, both outputs are zeroed first and the capture folder says why. Raises
    ConfigError before energising; DeviceError, InterlockError, RunError, KeyboardInterrupt or
    Terminated afterwards, with a note (``__notes__``) on the folder.
    """
    planned = plan(experiment, rig_config)
    description = description_of(experiment)
    excitation: FloatArray | Dialogue | None = planned.commands
    if isinstance(experiment, ClosedLoop):
        excitation = Dialogue(experiment, planned)
    assert excitation is not None
    limits = Limits(rig_config)
    record = {"experiment": description, "rig": rig_config.model_dump(mode="json")}
    capture = Capture.create(root, name, record)
    with SignalHandling() as signals:
        sampling = Sampling(Rig(device, rig_config), limits, experiment.sample_rate, watch)
        run = _Run(experiment, planned.n_samples, excitation, sampling, capture, signals)
        return run.execute()


class _Run:
    """One run through its phases.

    excitation: commands (n_samples, 2) [V], or who answers every sample.
    """

    def __init__(
        self,
        experiment: Experiment,
        n_samples: int,
        excitation: FloatArray | Dialogue,
        sampling: Sampling,
        capture: Capture,
        signals: SignalHandling,
    ) -> None:
        self.experiment = experiment
        self.n_samples = n_samples
        self.excitation = excitation
        self.sampling = sampling
        self.rig = sampling.rig
        self.capture = capture
        self.signals = signals
        self.realtime = RealTime()

    def execute(self) -> RunResult:
        """All phases; the record in the capture folder names how they ended."""
        log = None
        columns = self.experiment.columns if isinstance(self.experiment, ClosedLoop) else ()
        try:
            with LogWriter(self.capture.log_path, tuple(columns)) as log:
                self._all_phases(log)
                log.require_there()
        except (RigError, KeyboardInterrupt, Terminated) as error:
            self._finish(*self._outcome(error))
            error.add_note(self._kept(log))
            raise
        except USER_CODE_ERRORS as error:
            phase = self.sampling.phase.value
            failed = DeviceError(
                f"the backend failed during {phase}: {type(error).__name__}: {error}; "
                "outputs were set to zero. Mend the backend, or report this to who maintains it"
            )
            self._finish(*self._outcome(failed))
            failed.add_note(self._kept(log))
            raise failed from error
        self._finish(COMPLETED, None)
        record = self.capture.record
        return RunResult(self.capture.folder, log.n_samples, record["timing"], record["realtime"])

    def _kept(self, log: LogWriter | None) -> str:
        """Where the record of a run is that ended early."""
        n = log.n_samples if log is not None else 0
        late = self.sampling.timing.flags.get("held", 0)
        punctuality = f", {late} commands came too late" if late else ""
        folder = self.capture.folder
        return f"what was recorded until then: {folder} ({n} samples of the run{punctuality})"

    def _all_phases(self, log: LogWriter) -> None:
        try:
            try:
                self._phases_under_power(log)
            finally:
                # A signal between here and the shield raises: the outer try answers that.
                self.signals.shield()
        except BaseException:
            self._leave()
            # A device that failed may fail to close as well; why it failed is what counts.
            broken = (Exception, KeyboardInterrupt, Terminated)
            with contextlib.suppress(*broken), self.signals.breakable():
                self.rig.close()
            raise
        self._leave()
        self.sampling.phase = Phase.CLOSE
        with self.signals.breakable():
            self.rig.close()

    def _phases_under_power(self, log: LogWriter) -> None:
        sampling, record = self.sampling, self.capture.record
        sampling.enter(Phase.OPEN)
        info = self.rig.open()
        record["device"] = info.name
        self._schedule(info.virtual_time)
        sampling.enter(Phase.CALIBRATION)
        calibrate(sampling, self.experiment.calibration, record)
        if self.experiment.homing.turns > 0.0:
            sampling.enter(Phase.HOMING, self.experiment.homing.turns)
            home(sampling, self.experiment.homing, record)
        sampling.enter(Phase.RUN)
        if isinstance(self.excitation, Dialogue):
            control(sampling, log, self.excitation, self.n_samples)
        else:
            play(sampling, log, self.excitation)
        sampling.enter(Phase.SAFE)

    def _leave(self) -> None:
        """Zero outputs, whatever came before; ordinary scheduling."""
        self.rig.safe()
        self.realtime.undo()

    def _schedule(self, virtual_time: bool) -> None:
        wanted = self.rig.config.realtime
        # A clock that waits for the host needs no haste, and would starve the machine of it.
        self.realtime.begin("off" if virtual_time else wanted)
        self.capture.record["realtime"] = {
            "asked": wanted,
            "needed": not virtual_time,
            "granted": self.realtime.granted,
            "refused": self.realtime.refused,
        }

    def _outcome(self, error: BaseException) -> tuple[str, str]:
        """Status and reason that the capture folder keeps of a run that ended early."""
        where = f"during {self.sampling.phase.value}"
        if isinstance(error, KeyboardInterrupt):
            return "stopped", f"stopped by Ctrl-C {where}"
        if isinstance(error, Terminated):
            return "stopped", f"stopped by {error} {where}"
        return "interlock" if isinstance(error, InterlockError) else "failed", str(error)

    def _finish(self, status: str, reason: str | None) -> None:
        # A backend that failed may fail to report as well.
        with contextlib.suppress(Exception):
            if connection := self.rig.report():
                self.capture.record["connection"] = connection
        # A record that cannot be written (the disk is full) must not hide why the run ended;
        # the folder then still says "running", which a reader reports as interrupted.
        phase, timing = self.sampling.phase.value, self.sampling.timing.summary()
        with contextlib.suppress(RigError):
            self.capture.finish(status, reason, phase=phase, timing=timing)
