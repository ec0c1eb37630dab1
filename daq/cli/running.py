"""``rig run`` and ``rig check``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from daq.cli import console, punctuality
from daq.cli.analysing import analyse, as_document, next_command, show_findings
from daq.cli.files import DEFAULT_RIG, LoadedExperiment, load_experiment, load_rig
from daq.config.rig import RigConfig
from daq.errors import ConfigError
from daq.experiment import Plan
from daq.hal import CHANNELS, Device, Phase, Reporting
from daq.run import PhaseProgress, RunResult, run_experiment

_TITLES = {
    Phase.CALIBRATION: "Offset calibration",
    Phase.HOMING: "Winding the load",
    Phase.RUN: "Exciting and logging",
}


def run_command(
    experiment: str,
    rig: str,
    port: str | None,
    out: Path,
    identify: bool,
    model: str | None,
    config: Path | None,
    realtime: bool,
    as_json: bool,
) -> None:
    """Run an experiment; with ``identify`` record a validation run and identify the model."""
    loaded = load_experiment(experiment)
    rig_config, device = _load(rig, port, realtime)
    loaded.plan(rig_config)
    validation = loaded.validation()
    if validation is not None:
        # Checked even where it will not run: a mistake in the file is best heard of early.
        validation.plan(rig_config)
    if not identify:
        validation = None
    overrides = {"model": model}
    prepared = None
    if identify:
        from daq.cli.preparing import prepare

        # A mistake in the model must show before the rig moves.
        prepared = prepare(config, overrides)
    result = _run(loaded, rig_config, device, out, as_json)
    found = analyse(loaded.experiment, result.folder)
    check = _run(validation, rig_config, device, out, as_json) if validation else None
    report = {
        "run": punctuality.as_document(result),
        "validation": punctuality.as_document(check) if check else None,
    }
    if found is not None:
        report["findings"] = as_document(found, result.folder)
        if not as_json:
            show_findings(found, result.folder)
    if prepared is not None:
        from daq.cli.identifying import identify_logs

        if check is None and not as_json:
            console.report_note(
                f"{loaded.file.path} has no 'validation' section, so there is no validation run"
            )
        folders = [check.folder] if check else []
        report["identification"] = identify_logs(
            prepared, [result.folder], folders, result.folder / "identification", as_json
        )
    if as_json:
        console.print_json(report)
        return
    _print_end(result, check, identify)


def _load(rig: str, port: str | None, realtime: bool = False) -> tuple[RigConfig, Device]:
    """A rig on a port in place of its file's, or simulated at the pace of the clock."""
    config, device = load_rig(rig)
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
    return load_rig(rig, changes) if changes else (config, device)


def check_command(experiment: str, rig: str, port: str | None, as_json: bool) -> None:
    """Validate an experiment and say what it would do."""
    loaded = load_experiment(experiment)
    rig_config, _device = _load(rig, port)
    planned = loaded.plan(rig_config)
    validation = loaded.validation()
    if validation is not None:
        validation.plan(rig_config)
    settings = loaded.experiment
    seconds = planned.n_samples / settings.sample_rate
    channels = _channels(planned, rig_config)
    if as_json:
        console.print_json(
            {
                "experiment": str(loaded.file.path),
                "protocol": settings.protocol,
                "mode": settings.mode.value,
                "sample_rate_hz": settings.sample_rate,
                "samples": planned.n_samples,
                "duration_seconds": seconds,
                "channels": channels,
                "remarks": list(planned.remarks),
                "validation_run": validation is not None,
                "rig": rig_config.name,
            }
        )
        return
    most = "up to " if planned.commands is None else ""
    console.print_table(
        f"{loaded.file.path} on {rig_config.name}: "
        f"{most}{planned.n_samples} samples at {settings.sample_rate:g} Hz, {most}{seconds:g} s",
        ["channel", "lowest [V]", "highest [V]", "mean [V]", "changes", "limits [V]"],
        [
            [
                name,
                console.number(facts["lowest_volts"], 3),
                console.number(facts["highest_volts"], 3),
                console.number(facts.get("mean_volts", math.nan), 3),
                str(facts.get("changes", "-")),
                "{:g} to {:g}".format(*facts["limits_volts"]),
            ]
            for name, facts in channels.items()
        ],
    )
    for remark in planned.remarks:
        console.print_line(remark)
    turns = settings.homing.turns
    before = [f"{settings.calibration.samples} samples of offset calibration"]
    if turns > 0:
        before.append(f"{turns:g} turns to wind within {settings.homing.timeout:g} s")
    console.print_line(f"Before it: {', '.join(before)}.")
    console.print_line(
        "With --identify a validation run follows." if validation else
        "It has no 'validation' section: rig run --identify will identify without validation."
    )  # fmt: skip
    on = f" --rig {rig}" if rig != DEFAULT_RIG else ""
    on += f" --port {port}" if port is not None else ""
    console.print_next(f"rig run {experiment}{on} --identify")


def _channels(planned: Plan, rig: RigConfig) -> dict[str, dict[str, Any]]:
    """What a plan does to each channel; mean and changes only of commands known beforehand."""
    channels: dict[str, dict[str, Any]] = {}
    for index, name in enumerate(CHANNELS):
        channels[name] = {
            "lowest_volts": float(planned.lowest[index]),
            "highest_volts": float(planned.highest[index]),
            "limits_volts": list(getattr(rig.limits.command, name)),
        }
        if planned.commands is not None:
            column = planned.commands[:, index]
            channels[name]["mean_volts"] = float(column.mean())
            channels[name]["changes"] = int(np.count_nonzero(np.diff(column)))
    return channels


def _run(
    loaded: LoadedExperiment, rig: RigConfig, device: Device, out: Path, as_json: bool
) -> RunResult:
    if not as_json:
        console.report_note(f"{loaded.name} on {rig.name}")
    with console.progress(quiet=as_json) as bar:

        def watch(step: PhaseProgress) -> None:
            done = f"{step.done:.0f}" if step.unit == "samples" else f"{step.done:.1f}"
            bar.update(
                _TITLES[step.phase], step.done, step.total, f"{done}/{step.total:g} {step.unit}"
            )

        result = run_experiment(loaded.experiment, loaded.name, rig, device, out, watch)
    if isinstance(device, Reporting) and not as_json:
        for warning in device.report().get("warnings", []):
            console.report_warning(warning)
    return result


def _print_end(result: RunResult, check: RunResult | None, identified: bool) -> None:
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
    if not identified:
        console.print_next(next_command(result.folder))
