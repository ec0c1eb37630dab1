"""``rig run``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from daq.cli import terminal as console
from daq.cli.analyse import analyse, as_document, next_commands, show_findings
from daq.config.rig import RigConfig
from daq.diagnose import currents as plausible
from daq.diagnose import punctuality
from daq.errors import ConfigError, together
from daq.experiment import Plan
from daq.hal import Device, Phase, Reporting
from daq.logs.capture import LOG_NAME
from daq.lookup.experiments import LoadedExperiment, load_experiment
from daq.lookup.rigs import load_rig, rig_for
from daq.run.runner import RunResult, run_experiment
from daq.run.sampling import PhaseProgress

_TITLES = {
    Phase.CALIBRATION: "Offset calibration",
    Phase.HOMING: "Winding the load",
    Phase.RUN: "Exciting and logging",
}


def run_command(
    experiment: str,
    rig: str | None,
    port: str | None,
    out: Path,
    identify: bool,
    model: str | None,
    config: Path | None,
    realtime: bool,
    publishing: bool,
    as_json: bool,
) -> None:
    """Run an experiment; with ``identify`` record a validation run and identify the model.

    publishing: write the identification's report as well.
    """
    planned = plan_of(experiment, rig, port, realtime)
    loaded, rig_config, device = planned.loaded, planned.rig, planned.device
    validation = planned.validation if identify else None
    overrides = {"model": model}
    prepared = None
    if identify:
        from daq.identification.settings import prepare

        # A mistake in the model must show before the rig moves.
        prepared = prepare(config, overrides)
    result = _run(loaded, rig_config, device, out, as_json)
    found = analyse(loaded.experiment, result.folder)
    check = _run(validation, rig_config, device, out, as_json) if validation else None
    doubts = plausible.notes(result.folder / LOG_NAME, rig_config)
    report = {
        "run": punctuality.as_document(result),
        "validation": punctuality.as_document(check) if check else None,
        "warnings": doubts,
    }
    if found is not None:
        report["findings"] = as_document(found, result.folder)
        if not as_json:
            show_findings(found, result.folder)
    if not as_json:
        _print_end(result, check, identify, doubts)
    if prepared is not None:
        from daq.cli.identify import identify_logs

        if check is None and not as_json:
            console.report_note(
                f"{loaded.file.path} has no 'validation' section, so there is no validation run"
            )
        folders = [check.folder] if check else []
        report["identification"] = identify_logs(
            prepared, [result.folder], folders, result.folder / "identification", as_json,
            publishing=publishing,
        )  # fmt: skip
    if as_json:
        console.print_json(report)


@dataclass(frozen=True)
class Planned:
    """An experiment and the rig it is for, checked; plan: what the experiment itself will do."""

    loaded: LoadedExperiment
    validation: LoadedExperiment | None
    rig: RigConfig
    device: Device
    plan: Plan


def plan_of(experiment: str, rig: str | None, port: str | None, realtime: bool = False) -> Planned:
    """Read and check an experiment, its validation run and a rig; ConfigError with all mistakes.

    rig: default what the experiment's file says it is for.
    """
    loaded, (config, device) = together(
        lambda: load_experiment(experiment, console.report),
        lambda: rig_on(rig or rig_for(experiment, console.report), port, realtime),
    )
    # Checked even where it will not run: a mistake in the file is best heard of early.
    validation = loaded.validation()
    runs = [run for run in (loaded, validation) if run is not None]
    plans = together(*[partial(run.plan, config) for run in runs])
    return Planned(loaded, validation, config, device, plans[0])


def rig_on(rig: str, port: str | None, realtime: bool = False) -> tuple[RigConfig, Device]:
    """A rig on a port in place of its file's, or simulated at the pace of the clock."""
    config, device = load_rig(rig, notify=console.report)
    options = type(config.options).model_fields
    if port is not None and "port" not in options:
        raise ConfigError(
            f"--port {port}: the backend {config.backend!r} of {rig} has no port; name the rig "
            "file of one that has, such as --rig serial.yaml"
        )
    if realtime and "time" not in options:
        console.report_note(f"{rig}: its own clock paces it; --realtime changes nothing")
        realtime = False
    asked = {"port": port, "time": "real" if realtime else None}
    changes = {key: value for key, value in asked.items() if value is not None}
    return load_rig(rig, changes, console.report) if changes else (config, device)


def _run(
    loaded: LoadedExperiment, rig: RigConfig, device: Device, out: Path, as_json: bool
) -> RunResult:
    if not as_json:
        console.report_note(f"{loaded.name} on {rig.name}")
    with console.progress(quiet=as_json) as bar:

        def watch(step: PhaseProgress) -> None:
            done = f"{step.done:.0f}" if step.unit == "samples" else f"{step.done:.1f}"
            bar.update(
                _TITLES[step.phase], step.done, step.total, f"{done}/{step.total:.10g} {step.unit}"
            )

        result = run_experiment(loaded.experiment, loaded.name, rig, device, out, watch)
    if isinstance(device, Reporting) and not as_json:
        for warning in device.report().get("warnings", []):
            console.report_warning(warning)
    return result


def _print_end(
    result: RunResult, check: RunResult | None, identified: bool, doubts: list[str]
) -> None:
    for label, run in (("Log", result), ("Validation log", check)):
        if run is None:
            continue
        flagged = run.timing["flagged_samples"]
        notes = ", ".join(f"{count} {name}" for name, count in flagged.items())
        console.print_line(
            f"{label}: {run.folder / 'log.csv'} ({run.n_samples} samples"
            + (f"; flagged: {notes})" if notes else ")")
        )
        line = punctuality.summary_line(run)
        if line is not None:
            console.print_line(line)
        for note in punctuality.notes(run):
            console.report_note(note)
    for doubt in doubts:
        console.report_warning(doubt)
    if not identified:
        console.print_next(*next_commands(result.folder))
