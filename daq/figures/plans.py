"""What a run will do, before anything is energised: waveforms and their spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DEEPEST = 1e-4  # of the largest line: what is below it is rounding or leakage

_FEW = 200  # lines that are drawn one by one


@dataclass(frozen=True)
class Waveform:
    """Commands of a channel [V], (n_samples,), and the sizes of their spectral lines [V], (m,)."""

    name: str
    commands: FloatArray
    lines: FloatArray


@style.styled
def planned_commands(
    time: FloatArray, frequency: FloatArray, channels: Sequence[Waveform]
) -> Figure:
    """Each channel over time [s], (n_samples,), then over frequency [Hz], (m,)."""
    n = len(channels)
    gaps = [0.13] * (n - 1) + [0.42] + [0.13] * (n - 1)
    figure, panels = style.stack([0.75] * (2 * n), gaps, top=0.1, share_x=False)
    over_time, over_frequency = panels[:n], panels[n:]
    for panel, channel in zip(over_time, channels, strict=True):
        panel.plot(*style.thinned(time, channel.commands), drawstyle="steps-post",
                   color=style.MEASURED, lw=0.8)  # fmt: skip
        style.name_y(panel, channel.name, "[V]")
        panel.margins(x=0.01)
    for panel, channel in zip(over_frequency, channels, strict=True):
        _lines(panel, frequency, channel)
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


def _lines(panel: Axes, frequency: FloatArray, channel: Waveform) -> None:
    """Sizes of the lines; a held channel has none."""
    largest = float(np.max(channel.lines, initial=0.0))
    style.name_y(panel, f"{channel.name} amplitude", "[V]")
    if largest == 0.0:
        panel.set_yticks([])
        panel.set_xlim(0.9 * frequency[0], 1.1 * frequency[-1])
        style.logarithmic(panel.xaxis, frequency)
        panel.text(0.5, 0.5, "held", ha="center", va="center", transform=panel.transAxes)
        return
    floor = _DEEPEST * largest
    there = channel.lines > floor
    if np.count_nonzero(there) < _FEW:
        # A curve would join lines that have nothing between them.
        panel.vlines(frequency[there], floor, channel.lines[there], color=style.BASELINE, lw=0.5)
        panel.plot(frequency[there], channel.lines[there], "o", ms=1.6, color=style.BASELINE)
    else:
        panel.plot(frequency, np.maximum(channel.lines, floor), color=style.BASELINE, lw=0.6)
    panel.set_ylim(floor, 2.0 * largest)
    panel.set_xlim(0.9 * frequency[0], 1.1 * frequency[-1])
    style.logarithmic(panel.yaxis, np.array([floor, largest]))
    style.logarithmic(panel.xaxis, frequency)


def _common(panels: Sequence[Axes], label: str) -> None:
    """One axis under panels of the same range."""
    for panel in panels:
        panel.tick_params(labelbottom=panel is panels[-1])
    panels[-1].set_xlabel(label)
