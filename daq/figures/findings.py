"""Figures of what a protocol concludes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq import notation
from daq.figures import style
from daq.findings import Axis, Chart, Heatmap, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LETTERS_A_LINE = 62  # of a title across a column of print
_LEFT, _SHORT = 0.6, 34  # in, left of a panel, and letters of a label on one line
_SCALE = 0.12  # in, for a power of ten above the panel
_EDGE = 0.16  # in, where the legend's room begins


@style.styled
def draw(figure: Chart | Heatmap) -> Figure:
    """A figure of a chart or of a value over a plane."""
    title = style.wrapped(figure.title, _LETTERS_A_LINE)
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
    from matplotlib.patheffects import withStroke

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


def _label(axis: Axis) -> str:
    return f"{notation.words(axis.label)} {notation.bracketed(axis.unit)}"
