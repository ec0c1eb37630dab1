"""Signals over time and their spectra: planned, recorded, simulated, left in the residuals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.figures.stretch import busiest_stretch
from daq.hal import FloatArray

_DEEPEST = 1e-4  # of the largest line: what is below it is rounding or leakage
_CLOSER = 0.4  # of the width, for the closer look
_FEW = 200  # lines that are drawn one by one


@dataclass(frozen=True)
class Panel:
    """One panel: lines of one unit by their names; an empty name is not in the legend.

    lines: each (n_samples,), NaN where a sample was lost. steps: values are held from their
    sample to the next. note: what stands above the panel.
    """

    name: str
    unit: str
    lines: Mapping[str, FloatArray]
    steps: bool = False
    note: str = ""


def closer_look(panels: Sequence[Panel]) -> slice | None:
    """Samples that are drawn closer beside the whole; None where all of it is legible."""
    return busiest_stretch([next(iter(panel.lines.values())) for panel in panels])


def closer_sentence(panels: Sequence[Panel]) -> str:
    """What a caption says of it, with a space before; empty where there is none."""
    if closer_look(panels) is None:
        return ""
    return " Beside it, closer, the stretch marked grey, in which these signals move most."


def with_closer(
    time: FloatArray, axes: Sequence[Axes], stretch: slice | None
) -> list[tuple[slice, Sequence[Axes]]]:
    """Samples and the panels that show them: all, and a stretch beside it that is marked grey."""
    views: list[tuple[slice, Sequence[Axes]]] = [(slice(None), axes)]
    if stretch is not None:
        views.append((stretch, style.split(axes, _CLOSER)))
        ends = time[stretch][[0, -1]]
        for panel in axes:
            panel.axvspan(*ends, color=style.FAINT, alpha=0.6, lw=0.0, zorder=0.5)
    return views


@style.styled
def signals(time: FloatArray, panels: Sequence[Panel]) -> Figure:
    """Panels over one time axis [s], (n_samples,); ``asked`` is drawn behind what came of it.

    Of a record that swings too often to be read, ``closer_look`` is drawn beside it.
    """
    several = [panel for panel in panels if any(panel.lines)]
    figure, axes = style.stack([0.62] * len(panels), 0.13, top=0.2 if several else 0.1)
    views = with_closer(time, axes, closer_look(panels))
    for part, beside in views:
        for axis, panel in zip(beside, panels, strict=True):
            for name, values in panel.lines.items():
                behind = name == "asked"
                axis.plot(
                    *style.thinned(time[part], values[part]), label=name or None,
                    color=style.ASKED if behind else style.MEASURED, lw=1.8 if behind else 0.8,
                    drawstyle="steps-post" if panel.steps else "default",
                )  # fmt: skip
            axis.margins(x=0.01)
        beside[-1].set_xlabel("time [s]")
    for axis, panel in zip(axes, panels, strict=True):
        style.name_y(axis, notation.words(panel.name), notation.bracketed(panel.unit))
    if several:
        style.legend(figure, axes[panels.index(several[0])])
    return figure


@style.styled
def overlaid(times: tuple[FloatArray, FloatArray], panels: Sequence[Panel]) -> Figure:
    """Two lines a panel, each over its own time [s]: what it was, and drawn over it what it is."""
    names = list(panels[0].lines)
    figure, axes = style.stack([0.62] * len(panels), 0.13, top=0.2)
    looks: tuple[dict[str, Any], ...] = (
        {"color": style.ASKED, "lw": 1.6},
        {"color": style.IDENTIFIED, "lw": 0.8},
    )
    for axis, panel in zip(axes, panels, strict=True):
        drawn = "steps-post" if panel.steps else "default"
        for name, time, look in zip(names, times, looks, strict=True):
            axis.plot(*style.thinned(time, panel.lines[name]), label=name, drawstyle=drawn, **look)
        style.name_y(axis, notation.words(panel.name), notation.bracketed(panel.unit))
        axis.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")
    style.legend(figure, axes[0])
    return figure


@style.styled
def residual_correlations(
    lags: FloatArray, outputs: Mapping[str, Mapping[str, FloatArray]]
) -> Figure:
    """Correlations of each output's residual over lags [s], (n_lags,), in parts of their 95 % band.

    outputs: by name, lines by theirs: with its own past, then with inputs. Inside ±1 is what
    chance alone leaves, 95 times in 100.
    """
    names = list(next(iter(outputs.values())))
    figure, panels = style.stack([0.85] * len(outputs), 0.14, top=style.legend_room(names))
    for panel, (output, lines) in zip(panels, outputs.items(), strict=True):
        panel.axhspan(-1.0, 1.0, color="#eeeeee", lw=0, zorder=0)
        panel.axhline(0.0, color="black", lw=0.4, zorder=1)
        for k, (name, values) in enumerate(lines.items()):
            # At lag 0 a signal's correlation with itself says nothing.
            shown = slice(0 if k else 1, None)
            colour = style.CYCLE[(k - 1) % len(style.CYCLE)] if k else style.MEASURED
            dash = style.DASHES[(k - 1) % len(style.DASHES)] if k else "-"
            panel.plot(lags[shown], values[shown], color=colour, ls=dash, lw=0.8,
                       label=notation.words(name))  # fmt: skip
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -1.5), max(high, 1.5))
        style.name_y(panel, notation.words(output), "[1]")
        panel.margins(x=0.01)
    panels[-1].set_xlabel("lag [s]")
    style.legend(figure, panels[0])
    return figure


@style.styled
def spectra(
    frequency: FloatArray, densities: Mapping[str, FloatArray], units: Mapping[str, str]
) -> Figure:
    """One-sided power spectral density of each signal, (n,), over frequencies [Hz], (n,)."""
    figure, panels = style.stack([0.75] * len(densities), 0.13, top=0.1)
    for panel, (name, density) in zip(panels, densities.items(), strict=True):
        panel.plot(frequency, density, color=style.MEASURED)
        panel.margins(x=0.01)
        style.logarithmic(panel.yaxis, density)
        unit = notation.unit_text(units[name]) or "1"
        squared = f"({unit})²" if any(sign in unit for sign in "·/") else f"{unit}²"
        style.name_y(panel, notation.words(name), f"[{squared}/Hz]")
        panel.grid(visible=True, which="major")
    style.logarithmic(panels[-1].xaxis, frequency)
    panels[-1].set_xlabel("frequency [Hz]")
    return figure


@style.styled
def planned_commands(
    time: FloatArray, frequency: FloatArray, channels: Mapping[str, tuple[FloatArray, FloatArray]]
) -> Figure:
    """Each channel over time [s], (n_samples,), then over frequency [Hz], (m,).

    channels: by name, commands [V], (n_samples,), and the sizes of their spectral lines [V], (m,).
    """
    n = len(channels)
    gaps = [0.13] * (n - 1) + [0.42] + [0.13] * (n - 1)
    figure, panels = style.stack([0.75] * (2 * n), gaps, top=0.1, share_x=False)
    over_time, over_frequency = panels[:n], panels[n:]
    for panel, (name, (commands, _)) in zip(over_time, channels.items(), strict=True):
        panel.plot(*style.thinned(time, commands), drawstyle="steps-post", color=style.MEASURED,
                   lw=0.8)  # fmt: skip
        style.name_y(panel, name, "[V]")
        panel.margins(x=0.01)
    for panel, (name, (_, sizes)) in zip(over_frequency, channels.items(), strict=True):
        style.name_y(panel, f"{name} amplitude", "[V]")
        _lines(panel, frequency, sizes)
    _common(over_time, "time [s]")
    _common(over_frequency, "frequency [Hz]")
    return figure


@style.styled
def planned_references(
    time: FloatArray, references: Mapping[str, FloatArray], units: Mapping[str, str]
) -> Figure:
    """Each reference of a controller, (n_samples,), over time [s]; units by its name."""
    figure, panels = style.stack([0.75] * len(references), 0.13, top=0.1)
    for panel, (name, values) in zip(panels, references.items(), strict=True):
        panel.plot(*style.thinned(time, values), color=style.BASELINE)
        style.name_y(panel, notation.words(name), notation.bracketed(units.get(name, "")))
        panel.margins(x=0.01)
    _common(panels, "time [s]")
    return figure


def _lines(panel: Axes, frequency: FloatArray, sizes: FloatArray) -> None:
    """Sizes of the lines; a held channel has none."""
    panel.set_xlim(0.9 * frequency[0], 1.1 * frequency[-1])
    largest = float(np.max(sizes, initial=0.0))
    if largest == 0.0:
        panel.set_yticks([])
        style.logarithmic(panel.xaxis, frequency)
        panel.text(0.5, 0.5, "held", ha="center", va="center", transform=panel.transAxes)
        return
    floor = _DEEPEST * largest
    there = sizes > floor
    if np.count_nonzero(there) < _FEW:
        # A curve would join lines that have nothing between them.
        panel.vlines(frequency[there], floor, sizes[there], color=style.BASELINE, lw=0.5)
        panel.plot(frequency[there], sizes[there], "o", ms=1.6, color=style.BASELINE)
    else:
        panel.plot(frequency, np.maximum(sizes, floor), color=style.BASELINE, lw=0.6)
    panel.set_ylim(floor, 2.0 * largest)
    style.logarithmic(panel.yaxis, np.array([floor, largest]))
    style.logarithmic(panel.xaxis, frequency)


def _common(panels: Sequence[Axes], label: str) -> None:
    """One axis under panels of the same range."""
    for panel in panels:
        panel.tick_params(labelbottom=panel is panels[-1])
    panels[-1].set_xlabel(label)
