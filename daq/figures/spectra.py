"""Power spectral densities of signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Spectrum:
    """One-sided power spectral density of a signal, (n,), in its unit squared per Hz."""

    name: str
    unit: str
    density: FloatArray


@style.styled
def spectra(frequency: FloatArray, signals: Sequence[Spectrum]) -> Figure:
    """One panel for each signal over common frequencies [Hz], (n,), both logarithmic."""
    figure, panels = style.stack([0.75] * len(signals), 0.13, top=0.1)
    for panel, signal in zip(panels, signals, strict=True):
        panel.plot(frequency, signal.density, color=style.MEASURED)
        panel.margins(x=0.01)
        style.logarithmic(panel.yaxis, signal.density)
        unit = notation.unit_text(signal.unit) or "1"
        squared = f"({unit})²" if any(sign in unit for sign in "·/") else f"{unit}²"
        style.name_y(panel, notation.words(signal.name), f"[{squared}/Hz]")
        panel.grid(visible=True, which="major")
    style.logarithmic(panels[-1].xaxis, frequency)
    panels[-1].set_xlabel("frequency [Hz]")
    return figure
