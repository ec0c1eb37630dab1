"""``rig check``: what an experiment would do, without energising anything."""

from __future__ import annotations

import shlex
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from daq.cli import options, terminal
from daq.errors import ConfigError, together

if TYPE_CHECKING:
    from daq.experiment import Evidence
    from daq.hal import FloatArray
    from daq.recording.preview import ChannelFacts, Preview

_BARS = " ▁▂▃▄▅▆▇█"
_WIDTH, _HEIGHT = 58, 48.0  # characters and dB of a spectrum's sketch


def check(
    experiments: options.ExperimentNames,
    rig: options.RigOfRun = None,
    port: options.PortName = None,
    plot: Annotated[
        Path | None, Option(metavar="FILE.png|pdf|svg", help="Draw waveforms and spectra there.")
    ] = None,
    draws: Annotated[
        int,
        Option(
            metavar="N",
            min=0,
            max=100_000,
            help="Simulated trials where a torque controller acts, each with a plausible actuator "
            "and a hand of its own; what trips or does not come to rest is refused. 0: none.",
        ),
    ] = 1000,
    json: options.AsJson = False,
) -> None:
    """Say what experiments will do, and energise nothing.

    Each is checked against the rig's limits as before a run: duration, peaks, spectrum; and with a
    torque controller by trials.
    """
    from daq.recording import preview
    from daq.recording.session import lacks_port

    with terminal.watching(json) as watch:
        files = options.experiment_files(experiments)
        if plot is not None and len(files) > 1:
            problem = "it draws one experiment"
            raise ConfigError(problem, cure="name one of them", key="--plot")
        every = together(
            *(partial(preview.check, file, rig, port, draws=draws, watch=watch) for file in files)
        )
    checked = every[0]
    if plot is not None:
        preview.draw_preview(checked, plot)
    if json and len(every) > 1:
        terminal.print_json({"experiments": [each.document for each in every]})
        return
    if json:
        terminal.print_json({**checked.document, "plot": plot})
        return
    for each in every:
        _show(each, alone=len(every) == 1)
    if plot is not None:
        print(f"Figure: {plot}")
    if lacks_port(checked.session.rig):
        port = "PORT"  # to be filled in, as rig ports has it
        terminal.print_text(
            "No port is named in the rig's file, nor by --port: rig ports lists them."
        )
    validates = len(every) == 1 and checked.session.validation and not checked.concludes
    identify = " --identify" if validates else ""
    on_rig = options.rig_words(rig, port)
    behind = [] if on_rig or len(every) == 1 else options.next_of_design(files, None)
    terminal.print_next(*(behind or [f"rig run {shlex.join(experiments)}{on_rig}{identify}"]))


def _show(checked: Preview, *, alone: bool) -> None:
    plan, experiment, session = checked.plan, checked.experiment, checked.session
    at_most = "up to " if plan.commands is None else ""
    _show_channels(
        f"{session.loaded.file.path} on {session.rig.name}: {at_most}{plan.n_samples} samples at "
        f"{experiment.sample_rate:g} Hz, {at_most}{checked.seconds:g} s",
        checked.channels,
    )
    _show_references(checked)
    _sketch(checked)
    for remark in plan.remarks:
        terminal.print_text(remark)
    if plan.commands is not None:
        print(f"Frequency resolution: {checked.resolution:.4g} Hz")
    before = [f"{experiment.calibration.samples} samples of offset calibration"]
    if experiment.homing.turns > 0:
        before.append(
            f"{experiment.homing.turns:g} turns to wind within {experiment.homing.timeout:g} s"
        )
    terminal.print_text(f"Before it: {', '.join(before)}.")
    if checked.evidence is not None:
        _show_evidence(checked.evidence)
    for caveat in checked.caveats:
        terminal.print_text(f"Caveat: {caveat.text}.")
    if not plan.excites:
        print("Its commands are zero throughout: it excites nothing, and logs everything.")
    elif checked.concludes:
        print("It concludes by itself: results stand in the run's folder.")
    elif not alone:
        print()
    elif session.validation:
        print("With --identify a validation run follows.")
    else:
        terminal.print_text(
            "It has no 'validation' section: rig run --identify will identify without validation."
        )


def _show_evidence(evidence: Evidence) -> None:
    """What the trials came to."""
    rows = [[n.name, terminal.number(n.value), n.unit, n.meaning] for n in evidence.numbers]
    head = ["quantity", "value", "unit", "what it is"]
    terminal.print_table("Simulated trials", head, rows, text=["unit", "what it is"])
    for remark in evidence.remarks:
        terminal.print_text(remark)


def _show_channels(title: str, channels: dict[str, ChannelFacts]) -> None:
    """A column for each channel, without the rows that only a run would tell."""
    facts, number = list(channels.values()), terminal.number
    rows = [
        ["lowest", *(number(channel.lowest_volts, 3) for channel in facts)],
        ["highest", *(number(channel.highest_volts, 3) for channel in facts)],
        ["limits of the rig", *("{:g} to {:g}".format(*channel.limits_volts) for channel in facts)],
    ]
    if any(channel.mean_volts is not None for channel in facts):
        bands = [channel.power_band_hz or [None] for channel in facts]
        rows += [
            ["mean", *(_numbers(channel.mean_volts) for channel in facts)],
            ["rms about the mean", *(_numbers(channel.rms_volts) for channel in facts)],
            ["crest factor [1]", *(_numbers(channel.crest_factor) for channel in facts)],
            ["90 % of power [Hz]", *(_numbers(*band) for band in bands)],
        ]
    terminal.print_table(title, ["command [V]", *channels], rows)


def _numbers(*values: float | None) -> str:
    return " to ".join("-" if value is None else terminal.number(value, 3) for value in values)


def _show_references(checked: Preview) -> None:
    number, units = terminal.number, checked.units
    rows = [
        [name, number(values.min(), 3), number(values.max(), 3), units.get(name, "")]
        for name, values in checked.plan.references.items()
    ]
    if rows:
        head = ["reference", "lowest", "highest", "unit"]
        terminal.print_table("The controller will ask for", head, rows, text=["unit"])


def _sketch(checked: Preview) -> None:
    """Spectra in a line of text each, on a terminal that can show them."""
    from daq.hal import CHANNELS
    from daq.recording.preview import spectral_lines

    has_bars = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    plan = checked.plan
    if plan.commands is None or not sys.stdout.isatty() or not has_bars:
        return
    low = high = 0.0
    drawn = False
    for column, name in zip(plan.commands[plan.steady].T, CHANNELS, strict=True):
        frequency, amplitudes = spectral_lines(column, checked.experiment.sample_rate)
        low, high = float(frequency[0]), float(frequency[-1])
        if amplitudes.any():
            print(f"{name:<8} {_bars(frequency, amplitudes)}")
            drawn = True
    if not drawn:
        return
    ends = f"{low:.3g} Hz", f"{high:.3g} Hz"
    scale = f"{ends[0]}{' logarithmic '.center(_WIDTH - len(''.join(ends)), '·')}{ends[1]}"
    print(f"{'':<8} {scale}  bars: {_HEIGHT:g} dB\n")


def _bars(frequency: FloatArray, amplitudes: FloatArray) -> str:
    """Spectral lines as bars in dB: of each part of a logarithmic axis the largest line."""
    import numpy as np

    edges = np.geomspace(frequency[0], frequency[-1] * (1.0 + 1e-9), _WIDTH + 1)
    first = np.searchsorted(frequency, edges[:-1])
    last = np.searchsorted(frequency, edges[1:])
    # A part without a line shows the next line below it.
    first = np.where(last > first, first, np.maximum(last - 1, 0))
    parts = zip(first, np.maximum(last, first + 1), strict=True)
    largest = np.array([amplitudes[low:high].max() for low, high in parts])
    decibels = 20.0 * np.log10(np.maximum(largest / amplitudes.max(), 1e-9))
    steps = np.ceil((decibels / _HEIGHT + 1.0) * (len(_BARS) - 1))
    return "".join(_BARS[int(step)] for step in np.clip(steps, 0, len(_BARS) - 1))
