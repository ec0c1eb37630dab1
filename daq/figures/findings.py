"""Figures of what a protocol concludes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.findings import Axis, Chart, Heatmap, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw(figure: Chart | Heatmap) -> Figure:
    """A figure of a chart or of a value over a plane."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(5.0, 3.6), dpi=150, layout="constrained")
    axes = drawn.add_subplot()
    if isinstance(figure, Heatmap):
        mesh = axes.pcolormesh(figure.across, figure.up, figure.values, shading="nearest")
        drawn.colorbar(mesh, label=_label(figure.value))
    for series in figure.series:
        _add(axes, series)
    axes.set(title=figure.title, xlabel=_label(figure.x), ylabel=_label(figure.y))
    if figure.series:
        axes.legend(fontsize="small")
    return drawn


def _add(axes: Axes, series: Series) -> None:
    if series.spread is not None:
        axes.errorbar(
            series.x, series.y, series.spread, fmt="o", markersize=3, capsize=2, label=series.label
        )
    elif series.style == "points":
        axes.plot(series.x, series.y, "o", markersize=3, label=series.label)
    else:
        axes.plot(series.x, series.y, linewidth=1, label=series.label)


def _label(axis: Axis) -> str:
    return f"{axis.label} [{axis.unit}]" if axis.unit else axis.label
