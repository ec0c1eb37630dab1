"""What a search says: its convergence, parameters in their ranges, and models in their ranking."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq.figures import style
from daq.hal import FloatArray

_NUMBERED = 0.27  # in, width of a cell from which its correlation is written into it
_FRAME = 1.1  # of the width drawn, to which the panel reaches
_WIDEST = 8.0  # times the median width to which intervals are drawn
_BESIDE = 0.9  # of a cell's width up to which names stand beside each other
_TALLEST = 60.0  # points of a label's letters in an inch of its row
_NAME = 52  # letters of a model's name above its row


@style.styled
def convergence(
    errors: FloatArray, simulations_each: int, before_refinement: float | None = None
) -> Figure:
    """The best error after each generation, (n_generations,), over the simulations until then.

    before_refinement: the lowest error of the genetic search, where local least squares followed.
    """
    figure, (panel,) = style.stack([1.5], top=0.24)
    spent = simulations_each * np.arange(1, len(errors) + 1)
    panel.plot(spent, errors, color=style.IDENTIFIED, marker=".", ms=3.0, lw=0.9,
               label="best error")  # fmt: skip
    if before_refinement is not None and np.isfinite(before_refinement):
        panel.axhline(before_refinement, color=style.MEASURED, lw=0.7, ls="--",
                      label="genetic search alone")  # fmt: skip
    style.logarithmic(panel.yaxis, errors)
    panel.ticklabel_format(axis="x", style="plain")
    panel.set_xlabel("parameter sets simulated [1]")
    style.name_y(panel, "mean RMSE / max|y|", "[1]")
    style.legend(figure, panel)
    return figure


@style.styled
def ranges(names: Sequence[str], places: FloatArray, notes: Sequence[str]) -> Figure:
    """Each parameter's value and interval inside its range, from one end to the other.

    places: (n, 3) of the value and the interval's ends, from 0 at the range's low end to 1 at its
    high end; NaN where there is no interval. notes: what stands behind each row.
    """
    labels, left = style.row_names(names)
    figure, (panel,) = style.stack([0.155 * len(names) + 0.1], left=left, top=0.24, right=0.95)
    bar: dict[str, Any] = {"lw": 3.0, "solid_capstyle": "butt"}
    determined = [bool(np.isfinite(ends).all()) for ends in places[:, 1:]]
    for row, (value, *ends) in enumerate(places.tolist()):
        panel.plot([0.0, 1.0], [row, row], color=style.FAINT, zorder=1, **bar)
        if determined[row]:
            panel.plot(ends, [row, row], color=style.BASELINE, zorder=2, **bar)
        panel.plot(value, row, "o", ms=3.2, zorder=3, mec=style.IDENTIFIED, mew=0.8,
                   mfc=style.IDENTIFIED if determined[row] else "white")  # fmt: skip
        if notes[row]:
            panel.text(1.07, row, notes[row], va="center", fontsize=6.0)
    panel.plot([], [], color=style.FAINT, lw=3.0, label="range")
    if any(determined):
        panel.plot([], [], color=style.BASELINE, lw=3.0, label="95 % interval")
        panel.plot([], [], "o", ms=3.2, mfc=style.IDENTIFIED, mec=style.IDENTIFIED, label="value")
    if not all(determined):
        panel.plot([], [], "o", ms=3.2, mfc="white", mec=style.IDENTIFIED, label="no interval")
    style.legend(figure, panel, left=0.2)
    _name_rows(panel, labels)
    panel.set_xlim(-0.04, 1.04)
    panel.set_xticks([0.0, 0.5, 1.0], ["low end", "middle", "high end"])
    panel.set_xlabel("place in the range searched [1]")
    return figure


@style.styled
def intervals(names: Sequence[str], values: FloatArray) -> Figure:
    """95 % intervals in per cent of the values; values: (n, 3), each with its interval's ends."""
    labels, left = style.row_names(names)
    figure, (panel,) = style.stack([0.17 * len(names) + 0.1], left=left, top=0.1)
    sizes = np.where(values[:, :1] == 0.0, 1.0, np.abs(values[:, :1]))
    ends = 100.0 * (values[:, 1:] - values[:, :1]) / sizes
    widths = np.abs(ends).max(axis=1)
    # One that is hardly known must not flatten the others: it leaves the panel, with its width.
    limit = min(float(widths.max()), _WIDEST * float(np.median(widths)))
    for row, (below, above) in enumerate(ends.tolist()):
        panel.errorbar(
            0.0, row, xerr=[[abs(below)], [abs(above)]], fmt="o", ms=3.0, capsize=2.0,
            color=style.IDENTIFIED, ecolor=style.BASELINE, elinewidth=1.2, capthick=0.8,
        )  # fmt: skip
        if widths[row] > _FRAME * limit:
            shown = f"{below:.0f} .. +{above:.0f} %".replace("-", "−")
            panel.text(limit, row - 0.1, shown, ha="right", va="bottom", fontsize=6.0)
    panel.axvline(0.0, color="black", lw=0.4, zorder=1)
    _name_rows(panel, labels)
    panel.set_xlim(-_FRAME * limit, _FRAME * limit) if limit > 0.0 else None
    panel.set_xlabel("95 % interval, distance from the value [%]")
    return figure


def _name_rows(panel: Axes, labels: Sequence[str]) -> None:
    """Names beside rows, the first at the top."""
    panel.set_yticks(range(len(labels)), labels)
    panel.set_ylim(len(labels) - 0.4, -0.6)
    panel.grid(visible=False, axis="y")
    panel.tick_params(axis="y", length=0)


@style.styled
def correlation(names: Sequence[str], matrix: FloatArray) -> Figure:
    """Correlation coefficients of parameters, (n, n), NaN where there is none."""
    n = len(names)
    labels, left = style.row_names(names)
    right = 0.72
    side = style.WIDTH - left - right
    longest = max(map(style.text_width, labels))
    upright = longest > _BESIDE * side / n
    figure, (panel,) = style.stack(
        [side], left=left, right=right, top=0.12, bottom=longest + 0.14 if upright else 0.3
    )
    # Orange to violet keeps its order for readers who confuse red and green.
    image = panel.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
    panel.set_xticks(range(n), labels, rotation=90 if upright else 0)
    panel.set_yticks(range(n), labels)
    panel.grid(visible=False)
    panel.tick_params(length=0, labelsize=min(style.TICK_LABEL, _TALLEST * side / n))
    panel.spines[:].set_visible(False)
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


@style.styled
def ratios(names: Sequence[str], values: FloatArray) -> Figure:
    """Models' squared errors in parts of the best one's; an interval around 1 is no difference.

    values: (n, 3), each with the ends of its 95 % interval, the best model's first.
    """
    figure, (panel,) = style.stack([0.3 * len(names)], left=0.15, top=0.1)
    panel.axvline(1.0, color="black", lw=0.4, zorder=1)
    for place, (name, (value, low, high)) in enumerate(zip(names, values.tolist(), strict=True)):
        panel.errorbar(value, place, xerr=[[value - low], [high - value]], fmt="o", ms=3.0,
                       capsize=2.0, color=style.IDENTIFIED, ecolor=style.BASELINE,
                       elinewidth=1.2)  # fmt: skip
        shown = name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"
        panel.text(0.01, place - 0.28, shown.replace("$", r"\$"), fontsize=6.0, va="center",
                   bbox={"fc": "white", "ec": "none", "pad": 0.3},
                   transform=panel.get_yaxis_transform())  # fmt: skip
    ends = values[:, 1:]
    panel.set_ylim(len(names) - 0.5, -0.55)
    panel.set_xlim(0.9 * ends.min(), 1.1 * ends.max())
    style.logarithmic(panel.xaxis, ends)
    panel.set_yticks([])
    panel.spines["left"].set_visible(False)
    panel.set_xlabel("squared errors in validation, best model = 1 [1]")
    return figure
