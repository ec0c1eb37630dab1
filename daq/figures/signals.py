"""Time series under one another: what was commanded, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Panel:
    """One panel: lines of one unit by their names; an empty name is not in the legend.

    lines: each (n_samples,), NaN where a sample was lost. steps: values are held from their
    sample to the next.
    """

    label: str
    unit: str
    lines: Mapping[str, FloatArray]
    steps: bool = False


_COLOURS = {"asked": style.ASKED, "applied": style.MEASURED, "reference": style.BASELINE}


@style.styled
def signals(time: FloatArray, panels: Sequence[Panel]) -> Figure:
    """Panels over one time axis [s], (n_samples,)."""
    several = [panel for panel in panels if any(panel.lines)]
    figure, axes = style.stack([0.62] * len(panels), 0.13, top=0.2 if several else 0.1)
    for axis, panel in zip(axes, panels, strict=True):
        for name, values in panel.lines.items():
            x, y = style.thinned(time, values)
            axis.plot(
                x, y, label=name or None, color=_COLOURS.get(name, style.MEASURED),
                lw=1.8 if name == "asked" else 0.8,
                drawstyle="steps-post" if panel.steps else "default",
            )  # fmt: skip
        style.name_y(axis, notation.words(panel.label), notation.bracketed(panel.unit))
        axis.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")
    if several:
        shown = axes[panels.index(several[0])]
        style.legend(figure, shown)
    return figure
