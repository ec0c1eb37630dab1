"""``rig check``: what an experiment would do, without energising anything."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.cli import terminal as console
from daq.cli.run import plan_of
from daq.config.rig import RigConfig
from daq.errors import ConfigError, RunError
from daq.experiment import ClosedLoop, Experiment, Plan
from daq.files import write_whole
from daq.findings import Chart, Heatmap
from daq.hal import CHANNELS, FloatArray
from daq.logs.columns import UNITS
from daq.run.protocol import preview_of

_PART = 0.9  # of the power, that the stated band holds
_BARS = " ▁▂▃▄▅▆▇█"
_WIDE, _HIGH = 60, 48.0  # letters and dB of a spectrum's sketch


@dataclass(frozen=True)
class ChannelFacts:
    """What a plan does to a channel; of a closed loop only the range is known beforehand.

    Of the steady part: mean_volts; rms_volts, root mean square of the deviation from it;
    crest_factor, the largest deviation over that; power_band_hz, ends of the band that holds 90 %
    of its power, as much being below it as above; changes, samples that differ from the one
    before. A channel that is held has no crest factor and no band.
    """

    lowest_volts: float
    highest_volts: float
    limits_volts: tuple[float, float]
    mean_volts: float | None = None
    rms_volts: float | None = None
    crest_factor: float | None = None
    power_band_hz: tuple[float, float] | None = None
    changes: int | None = None


def check_command(
    experiment: str, rig: str | None, port: str | None, plot: Path | None, as_json: bool
) -> None:
    """Validate an experiment and say what it would do."""
    checked = plan_of(experiment, rig, port)
    loaded, rig_config, planned = checked.loaded, checked.rig, checked.plan
    validation, settings = checked.validation, loaded.experiment
    channels = {name: _facts(planned, rig_config, settings, name) for name in CHANNELS}
    units = {**UNITS, **settings.columns} if isinstance(settings, ClosedLoop) else {}
    if plot is not None:
        _draw(planned, settings, units, plot)
    if as_json:
        document = _document(planned, settings, channels)
        document["experiment"] = str(loaded.file.path)
        document["validation_run"] = validation is not None
        document["rig"] = rig_config.name
        document["plot"] = None if plot is None else str(plot)
        console.print_json(document)
        return
    seconds = planned.n_samples / settings.sample_rate
    most = "up to " if planned.commands is None else ""
    _show_channels(
        f"{loaded.file.path} on {rig_config.name}: "
        f"{most}{planned.n_samples} samples at {settings.sample_rate:g} Hz, {most}{seconds:g} s",
        channels,
    )
    _show_references(planned, units)
    _sketch(planned, settings)
    for remark in planned.remarks:
        console.print_line(remark)
    if planned.commands is not None:
        console.print_line(f"Frequency resolution: {_resolution(planned, settings):.4g} Hz")
    console.print_line(_before(settings))
    # What concludes something itself was not meant to excite everything.
    excites = type(settings).findings is Experiment.findings
    console.print_line(
        "It concludes by itself: results stand in the run's folder." if not excites else
        "With --identify a validation run follows." if validation else
        "It has no 'validation' section: rig run --identify will identify without validation."
    )  # fmt: skip
    if plot is not None:
        console.print_line(f"Figure: {plot}")
    on = f" --rig {rig}" if rig is not None else ""
    on += f" --port {port}" if port is not None else ""
    identify = " --identify" if validation and excites else ""
    console.print_next(f"rig run {experiment}{on}{identify}")


def _resolution(planned: Plan, settings: Experiment) -> float:
    """Distance of the spectral lines that the run can tell apart [Hz]."""
    return settings.sample_rate / len(range(planned.n_samples)[planned.steady])


def spectral_lines(column: FloatArray, sample_rate: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies [Hz] and sizes [V] of the cosines that a column's deviation is made of, (m,)."""
    deviation = column - column.mean()
    # A held channel's rounding is no excitation.
    if np.ptp(column) <= 1e-12 * np.max(np.abs(column)):
        deviation = np.zeros_like(deviation)
    sizes = np.abs(np.fft.rfft(deviation)) * 2.0 / len(column)
    if len(column) % 2 == 0:
        sizes[-1] *= 0.5
    frequency: FloatArray = np.arange(1.0, len(sizes)) * (sample_rate / len(column))
    return frequency, sizes[1:]


def _facts(planned: Plan, rig: RigConfig, settings: Experiment, name: str) -> ChannelFacts:
    index = CHANNELS.index(name)
    lowest, highest = float(planned.lowest[index]), float(planned.highest[index])
    limits = getattr(rig.limits.command, name)
    if planned.commands is None:
        return ChannelFacts(lowest, highest, limits)
    column = planned.commands[planned.steady, index]
    mean, changes = float(column.mean()), int(np.count_nonzero(np.diff(column)))
    frequency, sizes = spectral_lines(column, settings.sample_rate)
    power = np.cumsum(sizes**2)
    if power[-1] == 0.0:
        return ChannelFacts(lowest, highest, limits, mean, 0.0, changes=changes)
    rms = float(column.std())
    ends = np.searchsorted(power, power[-1] * np.array([0.5 - 0.5 * _PART, 0.5 + 0.5 * _PART]))
    low, high = frequency[ends].tolist()
    peak = float(np.max(np.abs(column - mean)))
    return ChannelFacts(lowest, highest, limits, mean, rms, peak / rms, (low, high), changes)


def _document(
    planned: Plan, settings: Experiment, channels: dict[str, ChannelFacts]
) -> dict[str, Any]:
    seconds = planned.n_samples / settings.sample_rate
    return {
        "protocol": settings.protocol,
        "mode": settings.mode.value,
        "sample_rate_hz": settings.sample_rate,
        "samples": planned.n_samples,
        "duration_seconds": seconds,
        "resolution_hz": _resolution(planned, settings),
        "channels": {name: asdict(facts) for name, facts in channels.items()},
        "references": {
            name: [float(values.min()), float(values.max())]
            for name, values in planned.references.items()
        },
        "remarks": list(planned.remarks),
    }


def _show_channels(title: str, channels: dict[str, ChannelFacts]) -> None:
    """A column for each channel; rows of what is not known beforehand are left out."""
    each = list(channels.values())
    rows = [
        ["lowest", *(console.number(facts.lowest_volts, 3) for facts in each)],
        ["highest", *(console.number(facts.highest_volts, 3) for facts in each)],
        ["limits of the rig", *("{:g} to {:g}".format(*facts.limits_volts) for facts in each)],
    ]
    if any(facts.mean_volts is not None for facts in each):
        rows += [
            ["mean", *(_or_dash(facts.mean_volts) for facts in each)],
            ["rms about the mean", *(_or_dash(facts.rms_volts) for facts in each)],
            ["crest factor [1]", *(_or_dash(facts.crest_factor) for facts in each)],
            ["90 % of power [Hz]", *(_band(facts.power_band_hz) for facts in each)],
        ]
    console.print_table(title, ["command [V]", *channels], rows)


def _band(ends: tuple[float, float] | None) -> str:
    return "-" if ends is None else " to ".join(console.number(end, 3) for end in ends)


def _or_dash(value: float | None) -> str:
    return "-" if value is None else console.number(value, 3)


def _show_references(planned: Plan, units: dict[str, str]) -> None:
    if not planned.references:
        return
    console.print_table(
        "The controller will ask for",
        ["reference", "lowest", "highest", "unit"],
        [
            [name, console.number(values.min(), 3), console.number(values.max(), 3),
             units.get(name, "")]
            for name, values in planned.references.items()
        ],
        text=["unit"],
    )  # fmt: skip


def _before(settings: Experiment) -> str:
    before = [f"{settings.calibration.samples} samples of offset calibration"]
    if settings.homing.turns > 0:
        before.append(
            f"{settings.homing.turns:g} turns to wind within {settings.homing.timeout:g} s"
        )
    return f"Before it: {', '.join(before)}."


def _sketch(planned: Plan, settings: Experiment) -> None:
    """Spectra in a line of text each, on a terminal that can show them."""
    can = (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"
    if planned.commands is None or not sys.stdout.isatty() or not can:
        return
    low = high = 0.0
    for index, name in enumerate(CHANNELS):
        frequency, sizes = spectral_lines(
            planned.commands[planned.steady, index], settings.sample_rate
        )
        low, high = float(frequency[0]), float(frequency[-1])
        if sizes.any():
            console.print_line(f"{name:<8} {_bars(frequency, sizes)}")
    ends = f"{low:.3g} Hz", f"{high:.3g} Hz"
    scale = f"{ends[0]}{' logarithmic '.center(_WIDE - len(''.join(ends)), '·')}{ends[1]}"
    console.print_line(f"{'':<8} {scale}  bars: {_HIGH:g} dB\n")


def _bars(frequency: FloatArray, sizes: FloatArray) -> str:
    """The largest line in each of equal parts of a logarithmic axis, as bars over decibels."""
    edges = np.geomspace(frequency[0], frequency[-1] * (1.0 + 1e-9), _WIDE + 1)
    first = np.searchsorted(frequency, edges[:-1])
    last = np.searchsorted(frequency, edges[1:])
    # Where no line falls in a part, the next below it stands for it.
    first = np.where(last > first, first, np.maximum(last - 1, 0))
    largest = np.array([np.max(sizes[a : max(b, a + 1)]) for a, b in zip(first, last, strict=True)])
    decibels = 20.0 * np.log10(np.maximum(largest / sizes.max(), 1e-9))
    steps = np.ceil((decibels / _HIGH + 1.0) * (len(_BARS) - 1))
    return "".join(_BARS[int(step)] for step in np.clip(steps, 0, len(_BARS) - 1))


def _preview(settings: Experiment) -> Chart | Heatmap | None:
    return preview_of(settings) if isinstance(settings, ClosedLoop) else None


def _draw(planned: Plan, settings: Experiment, units: dict[str, str], path: Path) -> None:
    """Waveforms and spectra, or what a closed loop can show, in a figure at a path."""
    from daq.figures import style
    from daq.figures.findings import draw
    from daq.figures.plans import Waveform, planned_commands, planned_references

    kind = style.format_of(path)
    time = np.arange(planned.n_samples) / settings.sample_rate
    if planned.commands is not None:
        channels = []
        for name, column in zip(CHANNELS, planned.commands.T, strict=True):
            frequency, sizes = spectral_lines(column[planned.steady], settings.sample_rate)
            channels.append(Waveform(name, column, sizes))
        drawn = planned_commands(time, frequency, channels)
    elif planned.references:
        m = max(map(len, planned.references.values()))
        drawn = planned_references(time[:m], planned.references, units)
    elif (preview := _preview(settings)) is not None:
        drawn = draw(preview)
    else:
        raise ConfigError(
            f"--plot {path}: {settings.protocol} says nothing beforehand of what its controller "
            "will ask for, so there is nothing to draw; leave --plot out, or give the plan "
            "'references' or the protocol a method 'preview'"
        )
    try:
        write_whole(path, style.render(drawn, kind))
    except RunError as error:
        raise ConfigError(f"{error}; or choose another place with --plot FILE.png") from None
