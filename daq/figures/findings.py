"""Figures of quantities over others: what a protocol concludes, what a model brings."""

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from daq import notation
from daq.figures import style
from daq.findings import Axis, Chart, Heatmap, Series
from daq.hal import FloatArray

_LETTERS_A_LINE = 62  # of a title across a column of print
_LEFT, _SHORT = 0.6, 34  # in, left of a panel, and letters of a label on one line
_SCALE = 0.12  # in, for a power of ten above the panel
_EDGE = 0.16  # in, where the legend's room begins
_THIN = {"lw": 0.5, "alpha": 0.7, "label": None}
_POINTS = 700  # of a cloud, beyond which a part looks the same
_LEGIBLE = 2.5  # times the size of a cloud's points, as a legend shows them


@style.styled
def draw(figure: Chart | Heatmap) -> Figure:
    """A figure of a chart or of a value over a plane."""
    title = "\n".join(textwrap.wrap(figure.title, _LETTERS_A_LINE)).replace("$", r"\$")
    heading = 0.05 + 0.13 * (title.count("\n") + 1)
    named = [series.label for series in figure.series if series.label]
    shown = named if len(named) > 1 or isinstance(figure, Heatmap) else []
    room = style.legend_room([notation.words(label) for label in shown], _EDGE) if shown else 0.0
    right = 0.72 if isinstance(figure, Heatmap) else 0.1
    left = _LEFT if len(figure.y.label) + len(figure.y.unit) < _SHORT else style.LEFT
    drawn, (panel,) = style.stack(
        [2.1], left=left, top=heading + max(room + 0.03, _SCALE), right=right
    )
    if isinstance(figure, Heatmap):
        _plane(drawn, panel, figure)
    for k, series in enumerate(figure.series):
        _add(panel, series, k, over=isinstance(figure, Heatmap))
    panel.set_xlabel(_label(figure.x))
    style.name_y(panel, notation.words(figure.y.label), notation.bracketed(figure.y.unit))
    tall = float(drawn.get_size_inches()[1])
    drawn.text(0.08 / style.WIDTH, 1 - 0.03 / tall, title, va="top", linespacing=1.15)
    if shown:
        style.legend(drawn, panel, _EDGE, above=heading - 0.02)
    return drawn


def _plane(drawn: Figure, panel: Axes, figure: Heatmap) -> None:
    # Violet to yellow by lightness alone, the same for all readers and in grey.
    mesh = panel.pcolormesh(
        figure.across, figure.up, figure.values, shading="nearest", cmap="cividis",
        rasterized=True,
    )  # fmt: skip
    box = panel.get_position()
    bar = drawn.colorbar(mesh, cax=drawn.add_axes((box.x1 + 0.02, box.y0, 0.03, box.height)))
    bar.set_label(_label(figure.value))
    panel.grid(visible=False)


def _add(panel: Axes, series: Series, k: int, over: bool) -> None:
    """One series; over: a plane, on which black with a white edge is seen everywhere."""
    look: dict[str, Any] = {
        "color": "black" if over else style.CYCLE[k % len(style.CYCLE)],
        "label": notation.words(series.label) or None,
        "path_effects": [withStroke(linewidth=2.2, foreground="white")] if over else None,
    }
    marker: dict[str, Any] = {"marker": "os^Dv"[k % 5], "ms": 3.0, "ls": ""}
    if series.spread is not None:
        panel.errorbar(series.x, series.y, series.spread, capsize=1.5, elinewidth=0.7,
                       **marker, **look)  # fmt: skip
    elif series.style == "points":
        panel.plot(series.x, series.y, **marker, **look)
    elif series.style == "model" and not over:
        look |= {"color": "black", "lw": 0.6, "zorder": 3}
        panel.plot(*style.thinned(series.x, series.y), **look)
    else:
        dash = style.DASHES[k % len(style.DASHES)]
        panel.plot(*style.thinned(series.x, series.y), ls=dash, **look)


def _shade(panel: Axes, x: FloatArray, low: FloatArray, high: FloatArray, color: str) -> None:
    """A band along a curve that may turn back, each way a part of its own."""
    turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(x))))
    for part in np.split(np.arange(len(x)), turns):
        rows = slice(max(part[0] - 1, 0), part[-1] + 1)
        panel.fill_between(x[rows], low[rows], high[rows], color=color, alpha=0.15, lw=0)


def _label(axis: Axis) -> str:
    return f"{notation.words(axis.label)} {notation.bracketed(axis.unit)}"


@style.styled
def plot(
    over: Mapping[str, str],
    quantity: Axis,
    curves: Mapping[str, Mapping[str, FloatArray]],
    points: bool = False,
    bands: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
    beyond: Mapping[str, npt.NDArray[np.bool_]] | None = None,
) -> Figure:
    """A panel over each of several quantities, such as a torque over angle and over speed.

    over: their units by name. curves: by label, values by the quantities' names, (n,). points:
    curves are clouds of measured samples. bands: by label, ends of the quantity, (n,) each. beyond:
    by label, (n,), where a curve is drawn thin.
    """
    figure, panels = style.stack(
        [1.45] * len(over), 0.42, top=style.legend_room(list(curves)), share_x=False
    )
    for panel, (name, unit) in zip(panels, over.items(), strict=True):
        for k, (label, values) in enumerate(curves.items()):
            stride = 1 + len(values[name]) // _POINTS if points else 1
            x, y = values[name][::stride], values[quantity.label][::stride]
            look: dict[str, Any] = {"ls": style.DASHES[k % len(style.DASHES)]}
            if points:
                look = {"ls": "", "marker": "ox^s"[k % 4], "ms": 1.4, "mew": 0.3, "mfc": "none"}
            look |= {"label": label, "color": style.CYCLE[k % len(style.CYCLE)]}
            if bands and label in bands:
                _shade(panel, x, *bands[label], look["color"])
            if beyond and label in beyond:
                panel.plot(x, np.where(beyond[label], y, np.nan), **look | _THIN)
                y = np.where(beyond[label], np.nan, y)
            panel.plot(x, y, **look)
        panel.set_xlabel(f"{name} {notation.bracketed(unit)}", labelpad=1.5)
        style.name_y(panel, quantity.label, notation.bracketed(quantity.unit))
    style.legend(figure, panels[0], marks=_LEGIBLE if points else 1.0)
    return figure
