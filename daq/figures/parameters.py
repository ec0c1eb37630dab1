"""What a search tells of parameters: intervals in their ranges, and correlations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NUMBERED = 0.27  # in, width of a cell from which its correlation is written into it

_WIDEST = 8.0  # times the median width to which intervals are drawn

_SHORT = 9  # letters up to which names stand beside each other


@dataclass(frozen=True)
class Searched:
    """A parameter in the range that it was searched in; without interval where there is none."""

    name: str
    unit: str
    value: float
    lower: float
    upper: float
    log: bool
    interval: tuple[float, float] | None
    note: str = ""


@dataclass(frozen=True)
class Determined:
    """A quantity that has an interval."""

    name: str
    value: float
    low: float
    high: float


@style.styled
def ranges(parameters: Sequence[Searched]) -> Figure:
    """Each parameter's value and interval inside its range, from one end to the other."""
    names, left = style.row_names([parameter.name for parameter in parameters])
    figure, (panel,) = style.stack([0.155 * len(parameters) + 0.1], left=left, top=0.24,
                                   right=0.95)  # fmt: skip
    for row, quantity in enumerate(parameters):
        panel.plot([0.0, 1.0], [row, row], color=style.FAINT, lw=3.0, solid_capstyle="butt",
                   zorder=1)  # fmt: skip
        determined = quantity.interval is not None
        if quantity.interval is not None:
            ends = [_place(quantity, end) for end in quantity.interval]
            panel.plot(ends, [row, row], color=style.BASELINE, lw=3.0, solid_capstyle="butt",
                       zorder=2)  # fmt: skip
        panel.plot(
            _place(quantity, quantity.value), row, "o", ms=3.2, zorder=3,
            mfc=style.IDENTIFIED if determined else "white", mec=style.IDENTIFIED, mew=0.8,
        )  # fmt: skip
        if quantity.note:
            panel.text(1.07, row, quantity.note, va="center", fontsize=6.0)
    _legend_of_ranges(figure, panel)
    panel.set_yticks(range(len(parameters)), names)
    panel.set_ylim(len(parameters) - 0.4, -0.6)
    panel.set_xlim(-0.04, 1.04)
    panel.set_xticks([0.0, 0.5, 1.0], ["low end", "middle", "high end"])
    panel.set_xlabel("place in the range searched [1]")
    panel.grid(visible=False, axis="y")
    panel.tick_params(axis="y", length=0)
    return figure


def _legend_of_ranges(figure: Figure, panel: Axes) -> None:
    panel.plot([], [], color=style.FAINT, lw=3.0, label="range")
    panel.plot([], [], color=style.BASELINE, lw=3.0, label="95 % interval")
    panel.plot([], [], "o", ms=3.2, mfc=style.IDENTIFIED, mec=style.IDENTIFIED, label="value")
    panel.plot([], [], "o", ms=3.2, mfc="white", mec=style.IDENTIFIED, label="no interval")
    style.legend(figure, panel, left=0.2)


def _place(quantity: Searched, value: float) -> float:
    """From 0 at the low end to 1 at the high end, on the scale of the search."""
    values = np.array([value, quantity.lower, quantity.upper])
    if quantity.log:
        values = np.log(np.maximum(values, np.finfo(float).tiny))
    place = float((values[0] - values[1]) / (values[2] - values[1]))
    # An interval may be wider than the range.
    return min(max(place, -0.04), 1.04)


@style.styled
def intervals(quantities: Sequence[Determined]) -> Figure:
    """The 95 % interval of every determined quantity, in per cent of its value."""
    names, left = style.row_names([quantity.name for quantity in quantities])
    figure, (panel,) = style.stack([0.17 * len(quantities) + 0.1], left=left, top=0.1)
    ends = np.array([_relative(quantity) for quantity in quantities])
    widths = np.abs(ends).max(axis=1)
    # One that is hardly known must not flatten the others: it leaves the panel, with its width.
    limit = min(float(widths.max()), _WIDEST * float(np.median(widths)))
    for row, (below, above) in enumerate(ends.tolist()):
        panel.errorbar(
            0.0, row, xerr=[[abs(below)], [abs(above)]], fmt="o", ms=3.0, capsize=2.0,
            color=style.IDENTIFIED, ecolor=style.BASELINE, elinewidth=1.2, capthick=0.8,
        )  # fmt: skip
        if widths[row] > limit:
            shown = f"{below:.0f} .. +{above:.0f} %".replace("-", "−")
            panel.text(limit, row - 0.1, shown, ha="right", va="bottom", fontsize=6.0)
    panel.axvline(0.0, color="black", lw=0.4, zorder=1)
    panel.set_yticks(range(len(quantities)), names)
    panel.set_ylim(len(quantities) - 0.4, -0.6)
    panel.set_xlim(-1.1 * limit, 1.1 * limit) if limit > 0.0 else None
    panel.set_xlabel("95 % interval, distance from the value [%]")
    panel.grid(visible=False, axis="y")
    panel.tick_params(axis="y", length=0)
    return figure


def _relative(quantity: Determined) -> tuple[float, float]:
    """Ends of an interval, in per cent of the value away from it."""
    size = abs(quantity.value) or 1.0
    return 100.0 * (quantity.low - quantity.value) / size, 100.0 * (
        quantity.high - quantity.value
    ) / size


@style.styled
def correlation(names: Sequence[str], matrix: FloatArray) -> Figure:
    """Correlation coefficients of parameters, (n, n), NaN where there is none."""
    n = len(names)
    labels, left = style.row_names(names)
    right = 0.72
    upright = max(len(name) for name in names) > _SHORT
    side = style.WIDTH - left - right
    figure, (panel,) = style.stack(
        [side], left=left, right=right, top=0.12, bottom=left if upright else 0.3
    )
    # Orange to violet keeps its order for readers who confuse red and green.
    image = panel.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
    panel.set_xticks(range(n), labels, rotation=90 if upright else 0)
    panel.set_yticks(range(n), labels)
    panel.grid(visible=False)
    panel.tick_params(length=0)
    for spine in panel.spines.values():
        spine.set_visible(False)
    if side / n >= _NUMBERED:
        for i, j in np.argwhere(np.isfinite(matrix)).tolist():
            dark = abs(matrix[i, j]) > 0.6
            shown = f"{round(matrix[i, j], 2) + 0.0:.2f}".replace("-", "−")
            panel.text(j, i, shown, ha="center", va="center",
                       fontsize=5.5 if side / n < 0.36 else 6.5,
                       color="white" if dark else "black")  # fmt: skip
    box = panel.get_position()
    beside = figure.add_axes((box.x1 + 0.02, box.y0, 0.025, box.height))
    bar = figure.colorbar(image, cax=beside, ticks=[-1.0, -0.5, 0.0, 0.5, 1.0])
    bar.set_label("correlation coefficient [1]", labelpad=2.0)
    bar.outline.set_linewidth(0.4)
    return figure
