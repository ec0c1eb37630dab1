"""An experiment on a rig, from their files to capture folders."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from daq.boards.card import require_phase
from daq.config.metadata import changes_of
from daq.config.rig import RigConfig
from daq.diagnose import currents
from daq.errors import ConfigError, together
from daq.experiment import Plan
from daq.findings import Findings
from daq.hal import Device, Phase
from daq.logs.capture import LOG_NAME, RUN_NAME
from daq.logs.metadata import amended
from daq.logs.recording import Recording, load
from daq.lookup.experiments import LoadedExperiment, load_experiment
from daq.lookup.rigs import load_rig, rig_for, rig_on
from daq.progress import Note, Progress, Started, Watch, ignore, warn
from daq.recording.analysis import conclude_or_warn
from daq.run.runner import RunResult, run_experiment
from daq.run.sampling import PhaseProgress

SEEDS = 2**32  # that a simulated rig takes
_ACTIVITIES = {
    Phase.CALIBRATION: "Offset calibration",
    Phase.HOMING: "Winding the load",
    Phase.RUN: "Exciting and logging",
}


@dataclass(frozen=True)
class Session:
    """An experiment and the rig it is for, both checked; plan: what the experiment will do.

    validation: the same experiment as its ``validation`` section changes it. rig_file: of the rig,
    as it is typed.
    """

    loaded: LoadedExperiment
    validation: LoadedExperiment | None
    rig: RigConfig
    device: Device
    plan: Plan
    rig_file: str

    def noting(self, notes: Iterable[str]) -> Session:
        """The same with notes as they are typed, over those of its file. Raises ConfigError."""
        notes = list(notes)
        validation = None if self.validation is None else _noting(self.validation, notes)
        return replace(self, loaded=_noting(self.loaded, notes), validation=validation)

    def record(self, out: Path, *, validation: bool, watch: Watch) -> SessionResult:
        """Run the experiment, and then its validation run where there is one and it is wanted.

        Raises DeviceError, InterlockError, RunError, KeyboardInterrupt or Terminated, whose notes
        say whether the outputs were read as zero then.
        """
        rig, device = _with_noise_of_its_own(self.rig, self.device, out)
        run = _run(self.loaded, rig, device, out, watch, self.rig_file)
        findings = conclude_or_warn(self.loaded.experiment, run.folder, watch)
        second = None
        if validation and self.validation is not None:
            second = _run(self.validation, rig, device, out, watch, self.rig_file)
        doubts = [doubt for each in (run, second) if each for doubt in each.doubts]
        doubts += currents.notes(run.folder / LOG_NAME, self.rig)
        return SessionResult(run, second, findings, doubts)


@dataclass(frozen=True)
class SessionResult:
    """Runs that were recorded; of the first its findings, and doubts on sensors with the cures."""

    run: RunResult
    validation: RunResult | None
    findings: Findings | None
    doubts: list[str]


def open_session(
    experiment: str,
    rig: str | None = None,
    port: str | None = None,
    realtime: bool = False,
    watch: Watch = ignore,
    *,
    to_run: bool = True,
) -> Session:
    """Read and check an experiment, its validation run and a rig; ConfigError with all mistakes.

    rig: default what the experiment's file says it is for. port, realtime: settings of its backend
    over those of its file. to_run: whether the rig has to be reachable.
    """

    def load_rig_of_it() -> tuple[str, RigConfig, Device]:
        name = rig or rig_for(experiment, watch)
        return name, *rig_on(name, port, realtime, watch)

    loaded, (name, config, device) = together(
        lambda: load_experiment(experiment, watch), load_rig_of_it
    )
    # Checked even where it will not run: a mistake in the file is best heard of early.
    validation = loaded.validation()
    runs = [run for run in (loaded, validation) if run is not None]
    return Session(loaded, validation, config, device, _plan(runs, config, name, to_run), name)


def record(
    experiment: str | Path,
    rig: str | Path | None = None,
    out: str | Path = "runs",
    validation: bool = False,
    options: Mapping[str, Any] | None = None,
    notes: Iterable[str] = (),
    *,
    watch: Watch = ignore,
) -> Recording:
    """Run an experiment on a rig; what it logged, ``frame`` as a table.

    Files as for ``rig run``, shipped ones among them. validation: the experiment with what its
    ``validation`` section changes. options: of the rig's backend, over those of its file. notes: of
    the run, each ``KEY=VALUE`` or text. Raises RigError with cause and cure, and a note on whether
    the outputs were read as zero then.

    >>> from daq import record
    >>> run = record("prbs.yaml", options={"seed": 1})
    >>> run.record["status"], len(run.frame)
    ('completed', 1000)
    """
    loaded = load_experiment(str(experiment), watch)
    if validation:
        changed = loaded.validation()
        if changed is None:
            problem = "it has no 'validation' section"
            raise ConfigError(problem, cure="add one", file=loaded.file.path)
        loaded = changed
    loaded = _noting(loaded, list(notes))
    name = str(rig or rig_for(str(experiment), watch))
    config, device = load_rig(name, options, watch)
    _plan([loaded], config, name)
    config, device = _with_noise_of_its_own(config, device, Path(out))
    return load(_run(loaded, config, device, Path(out), watch, name).folder)


def _noting(loaded: LoadedExperiment, notes: list[str]) -> LoadedExperiment:
    metadata = amended(loaded.experiment.metadata, changes_of(notes))
    return replace(loaded, experiment=loaded.experiment.model_copy(update={"metadata": metadata}))


def first_seed(folder: Path) -> int:
    """Seed of the first simulated run of a folder: 0, or in a folder of runs by its name.

    Runs of a design stand beside those before it, and are identified with them.

    >>> first_seed(Path("runs")), first_seed(Path("runs/design")) == first_seed(Path("runs/other"))
    (0, False)
    """
    whole, here = folder.resolve(), Path.cwd()
    inner = whole.relative_to(here) if whole.is_relative_to(here) else Path(whole.name)
    return zlib.crc32(inner.as_posix().encode()) if len(inner.parts) > 1 else 0


def _with_noise_of_its_own(rig: RigConfig, device: Device, out: Path) -> tuple[RigConfig, Device]:
    """A simulated rig whose file names no seed, with that of the next run in a folder.

    Noise that two logs share would pass for what both say of the plant.
    """
    options = rig.options
    if "seed" not in type(options).model_fields or getattr(options, "seed", None) is not None:
        return rig, device
    seed = (first_seed(out) + sum(1 for _ in out.glob(f"*/{RUN_NAME}"))) % SEEDS
    options = options.model_copy(update={"seed": seed})
    make: Callable[[Any], Device] = type(device)
    return rig.model_copy(update={"options": options}), make(options)


def _plan(
    runs: Sequence[LoadedExperiment], config: RigConfig, rig: str, to_run: bool = True
) -> Plan:
    """What the first of some runs will do; ConfigError with all that keeps any from being run."""
    first, *_ = together(
        *[partial(run.plan, config) for run in runs],
        *([partial(_require_port, config, rig)] if to_run else []),
        partial(require_phase, config.options, runs[0].experiment.mode, rig),
    )
    plan: Plan = first
    return plan


def lacks_port(config: RigConfig) -> bool:
    """Whether a rig is on a port that is still to be named."""
    return getattr(config.options, "port", None) == ""


def _require_port(config: RigConfig, rig: str) -> None:
    """Raise ConfigError for a rig on a port that is still to be named."""
    if lacks_port(config):
        cure = "give --port PORT, or write it there; 'rig ports' lists the ports that there are"
        raise ConfigError("no port is named", cure=cure, file=rig, key="options.port")


def _run(
    loaded: LoadedExperiment,
    rig: RigConfig,
    device: Device,
    out: Path,
    watch: Watch,
    rig_file: str,
) -> RunResult:
    watch(Started(f"{loaded.name} on {rig.name}"))

    def report(step: PhaseProgress | Note) -> None:
        if isinstance(step, Note):
            watch(step)
            return
        done = f"{step.done:.0f}" if step.unit == "samples" else f"{step.done:.1f}"
        status = f"{done}/{step.total:.10g} {step.unit}"
        watch(Progress(_ACTIVITIES[step.phase], step.done, step.total, status))

    result = run_experiment(loaded.experiment, loaded.name, rig, device, out, report, rig_file)
    warn(watch, *result.warnings)
    return result
