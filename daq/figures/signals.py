"""Signals over time and their spectra: planned, recorded, simulated, left in the residuals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import FloatArray

_DEEPEST = 1e-4  # of the largest line: what is below it is rounding or leakage
_FEW = 200  # lines that are drawn one by one
_INSIDE = 0.04  # of a frame's height, from its edge to what marks a curve beyond
_PLAIN = 1e-2, 1e4  # sizes whose numbers need no power of ten
_MARKS = 15  # of a curve beyond its frame, at most about so many at an edge
_EXCESS = 4.0  # times the first model's residual that another's is drawn to
# Of the first simulated line and the second; further ones have colours of their own.
_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": style.IDENTIFIED, "lw": 0.8, "zorder": 3},
    {"color": style.BASELINE, "lw": 0.6, "zorder": 2, "ls": (0, (3, 1))},
)


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


@style.styled
def signals(time: FloatArray, panels: Sequence[Panel]) -> Figure:
    """Panels over one time axis [s], (n_samples,); ``asked`` is drawn behind what came of it."""
    several = [panel for panel in panels if any(panel.lines)]
    figure, axes = style.stack([0.62] * len(panels), 0.13, top=0.2 if several else 0.1)
    for axis, panel in zip(axes, panels, strict=True):
        for name, values in panel.lines.items():
            behind = name == "asked"
            axis.plot(
                *style.thinned(time, values), label=name or None,
                color=style.ASKED if behind else style.MEASURED, lw=1.8 if behind else 0.8,
                drawstyle="steps-post" if panel.steps else "default",
            )  # fmt: skip
        style.name_y(axis, notation.words(panel.name), notation.bracketed(panel.unit))
        axis.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")
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
def responses(time: FloatArray, outputs: Sequence[Panel]) -> Figure:
    """Each output's response and, at its own scale below, measured minus simulated.

    Of each panel's lines the first is the measured one, the second of the model that the figure
    is about.
    """
    heights, gaps = [0.78, 0.4] * len(outputs), ([0.06, 0.26] * len(outputs))[:-1]
    figure, axes = style.stack(heights, gaps, top=0.36)
    leaves = [
        _respond(time, output, axes[2 * j], axes[2 * j + 1]) for j, output in enumerate(outputs)
    ]
    if any(leaves):
        axes[0].plot([], [], ls="", marker="^", ms=3, color="0.4", label="beyond frame")
    axes[-1].set_xlabel("time [s]")
    style.legend(figure, axes[0])
    return figure


def _respond(time: FloatArray, output: Panel, above: Axes, below: Axes) -> bool:
    """One output's two panels; whether a curve leaves its frame."""
    measured, *simulated = output.lines.values()
    factor, unit = _multiple(_largest(measured), output.unit)
    measured, simulated = factor * measured, [factor * values for values in simulated]
    above.plot(*style.thinned(time, measured), color=style.MEASURED, lw=1.5, label="measured")
    residuals = [measured - values for values in simulated]
    if residuals:
        smaller, unit_below = _multiple(_largest(residuals[0]) / factor, output.unit)
        residuals = [smaller / factor * residual for residual in residuals]
    else:
        unit_below = unit
    for k, (name, values) in enumerate(zip(list(output.lines)[1:], simulated, strict=True)):
        look = _LOOKS[k] if k < len(_LOOKS) else {**_LOOKS[1], "color": f"C{k}"}
        above.plot(*style.thinned(time, values), label=name, **look)
        below.plot(*style.thinned(time, residuals[k]), **look)
    # A model that runs away must flatten neither what was measured nor the other's residual.
    values = np.concatenate([measured, simulated[0]])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = 0.06 * (high - low) or 1.2
    above.set_ylim(low - room, high + room)
    sizes = [_largest(residual) for residual in residuals]
    largest = 1.06 * min(max(sizes), _EXCESS * sizes[0]) or 1.2
    below.set_ylim(-largest, largest)
    leaves = False
    for panel, curves in ((above, simulated), (below, residuals)):
        for k, curve in enumerate(curves):
            color = str(_LOOKS[k]["color"]) if k < len(_LOOKS) else f"C{k}"
            leaves |= _mark_leaving(panel, time, curve, color)
    below.axhline(0.0, color="black", lw=0.4, zorder=1)
    style.name_y(above, notation.words(output.name), unit)
    style.name_y(below, "residual", unit_below)
    for panel in (above, below):
        panel.margins(x=0.01)
    below.locator_params(axis="y", nbins=3)
    if output.note:
        above.set_title(output.note, loc="right", fontsize=6.5, pad=2.0)
    return leaves


def _multiple(largest: float, unit: str) -> tuple[float, str]:
    """By what values are multiplied to need no power of ten at their axis; their unit there."""
    if not math.isfinite(largest) or largest == 0.0 or _PLAIN[0] <= largest < _PLAIN[1]:
        return 1.0, notation.bracketed(unit)
    factor, prefixed = notation.engineering(largest, unit)
    if factor != 1.0:
        return factor, notation.bracketed(prefixed)
    power = 3 * math.floor(math.log10(largest) / 3.0)
    text = notation.unit_text(unit)
    raised = notation.raised(str(power))
    return 10.0**-power, f"[10{raised} {text}]" if text not in ("", "1") else f"[10{raised}]"


def _mark_leaving(panel: Axes, time: FloatArray, values: FloatArray, color: str) -> bool:
    """Mark each stretch of a curve beyond its frame at the edge; whether there is one."""
    low, high = panel.get_ylim()
    there = ~np.isnan(values)  # what is missing parts no stretch
    time, values = time[there], values[there]
    inside, places = _INSIDE * (high - low), list[tuple[float, float, str]]()
    ends = ((values > high, high - inside, "^"), (values < low, low + inside, "v"))
    for beyond, edge, marker in ends:
        steps = np.flatnonzero(np.diff(np.concatenate([[False], beyond, [False]]).astype(int)))
        middles = time[(steps[::2] + steps[1::2] - 1) // 2]
        places += [(at, edge, marker) for at in middles[:: max(1, len(middles) // _MARKS)]]
    for marker in ("^", "v"):
        here = [(at, edge) for at, edge, kind in places if kind == marker]
        if here:
            panel.plot(*np.transpose(here), ls="", marker=marker, ms=2.5, color=color,
                       clip_on=False, scalex=False, scaley=False)  # fmt: skip
    return bool(places)


def _largest(residual: FloatArray) -> float:
    return float(np.max(np.abs(residual), where=np.isfinite(residual), initial=0.0))


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
