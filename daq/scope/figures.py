"""The figures of a page: one for each quantity, over one axis of time."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import BasicTicker, ColumnDataSource, CrosshairTool, FactorRange, Range1d
from bokeh.models.annotations import Span
from bokeh.models.widgets import Div
from bokeh.plotting import figure

from daq.hal import FloatArray
from daq.logs.columns import UNITS
from daq.scope.history import View
from daq.scope.looks import (
    FLAG_COLORS,
    GREEN,
    GREY,
    RED,
    color_of,
    flag_name,
    groups_of,
    is_wanted,
    quantity_of,
)
from daq.scope.overlay import EarlierRun
from daq.scope.trigger import Trigger

_CALM = 0.03  # of a column's span that a stretch may cover and still be drawn as broad: 3 pixels
_BROAD, _BROAD_ABOVE = 6.0, 2.0  # pixels of what was asked, and of what came of it
_MARGIN, _FILLED = 0.06, 0.7  # parts of a figure's height: free at each end, filled at least
_NEAR = 0.7  # of a limit from which its line is shown
FLAGS = "flags"
_BEHIND, _LEVEL = "curve behind", "level of the trigger"
_GRAVE = ("lost", "interlock", "underflow")  # marked across all figures


class Sources:
    """Data of the figures: samples, flags, and lines across all figures."""

    def __init__(self) -> None:
        self.samples = ColumnDataSource({"t": []}, name="samples")
        self.flags = ColumnDataSource({"time": [], "flag": [], "color": []}, name="flags")
        self.lines = ColumnDataSource({"time": [], "color": [], "dash": []}, name="lines")


def make_figures(
    columns: Sequence[str],
    sources: Sources,
    time: Range1d,
    chosen: Collection[str],
    limits: Mapping[str, Sequence[float]],
) -> tuple[Any, list[figure]]:
    """The figures of the chosen quantities in a grid with one toolbar, and each by itself.

    limits: drawn as lines, by quantity.
    """
    cursor = Span(dimension="height", line_color=GREY, line_dash="dotted")
    plots = []
    for group in groups_of(columns):
        quantity = quantity_of(group[-1])
        if quantity in chosen:
            plot = _curve_figure(group, sources, time, cursor)
            if quantity in limits:
                ends = list(limits[quantity])
                lines = plot.hspan(y=ends, line_color=RED, line_dash="dotted")
                lines.name = f"limits of {quantity}"
            plots.append(plot)
    if "flags" in columns and (FLAGS in chosen or not plots):
        plots.append(_flag_strip(sources, time, cursor))
    if not plots:
        return Div(text="No channel is chosen."), []
    last = plots[-1]
    last.xaxis.axis_label = "t [s]"
    last.height = (last.height or 0) + 45
    for plot in plots[:-1]:
        plot.below = []  # an axis that is only invisible is measured and placed all the same
    for plot in plots:
        plot.vspan(
            x="time", source=sources.lines, line_color="color", line_dash="dash", line_alpha=0.7
        )
    grid = gridplot(
        [[plot] for plot in plots], toolbar_location="above", sizing_mode="stretch_width",
        toolbar_options={"logo": None},
    )  # fmt: skip
    return grid, plots


def lay_behind(plots: Sequence[figure], overlays: Sequence[EarlierRun]) -> None:
    """Draw runs behind the one that is shown, instead of those that were; cheaper than anew."""
    for plot in plots:
        kept = [curve for curve in plot.renderers if curve.name != _BEHIND]
        if plot.tags:
            name = plot.tags[-1]
            behind = [_draw(plot, run.samples, name, name, run.color) for run in overlays]
            for curve in behind:
                curve.name = _BEHIND
            kept = [*behind, *kept]
        if plot.renderers != kept:
            plot.renderers = kept


def show_level(plots: Sequence[figure], trigger: Trigger | None) -> None:
    """Draw a trigger's level as a line, instead of the one before."""
    for plot in plots:
        kept = [curve for curve in plot.renderers if curve.name != _LEVEL]
        if trigger is not None and trigger.channel in plot.tags:
            line = plot.hspan(y=[trigger.level], line_color=GREEN, line_dash="dashed")
            line.name = _LEVEL
            kept.append(line)
        if plot.renderers != kept:
            plot.renderers = kept


def fit(
    plot: figure,
    sources: Sources,
    limits: Sequence[float] = (),
    overlays: Sequence[EarlierRun] = (),
) -> None:
    """Have a figure's curves fill its height, without moving its axis at every little change.

    limits: there is room for those that the curves come near to. overlays: drawn behind.
    """
    drawn = [np.asarray(sources.samples.data[name]) for name in plot.tags]
    if not drawn or not len(drawn[0]):
        return
    drawn += [np.asarray(run.samples.data[plot.tags[-1]]) for run in overlays]
    together = np.concatenate(drawn)
    low, high = float(np.fmin.reduce(together)), float(np.fmax.reduce(together))
    high = max([high, *(end for end in limits if end > 0.0 and high > _NEAR * end)])
    low = min([low, *(end for end in limits if end < 0.0 and low < _NEAR * end)])
    if not high - low > 0.0:
        low, high = low - 1.0, high + 1.0
    shown: Any = plot.y_range
    inside = shown.start <= low and high <= shown.end
    fits = inside and high - low > _FILLED * (shown.end - shown.start)
    if math.isfinite(high - low) and not fits:
        margin = _MARGIN * (high - low)
        shown.update(start=low - margin, end=high + margin)


def make_value_table(values: ColumnDataSource, n_rows: int) -> figure:
    """The values at one time, drawn: new cells in a page's text would have it laid out anew."""
    x_range, y_range = Range1d(start=0, end=390), Range1d(start=n_rows - 0.5, end=-0.5)
    table = figure(width=390, height=24 * n_rows, x_range=x_range, y_range=y_range, tools="")
    table.name = "table"
    table.update(title=None, toolbar_location=None, outline_line_color=None, min_border=0)
    table.axis.visible = False
    table.grid.visible = False
    table.scatter(x=10, y="row", source=values, marker="square", size=10, color="color")
    look: dict[str, Any] = {"source": values, "text_font_size": "13px", "text_baseline": "middle"}
    for column, x, align in (
        ("channel", 22, "left"),
        ("value", 256, "right"),
        ("unit", 262, "left"),
        ("difference", 388, "right"),
    ):
        table.text(x, "row", column, text_align=align, text_font_style="style", **look)
    return table


def broad_name(column: str) -> str:
    """Name of a column that is drawn broad, in the source of samples."""
    return f"{column} broad"


def points_of(view: View) -> int:
    """Points drawn of each stretch: its lowest and highest value, which may be one and the same."""
    return 1 if view.step == 1 else 2


def as_data(columns: Sequence[str], view: View, span: FloatArray) -> dict[str, Any]:
    """Columns of the source of samples for a view.

    A line goes from the lowest to the highest value of each stretch. span: (n_columns,), from the
    lowest to the highest value of all there is.
    """
    each = points_of(view)
    data: dict[str, Any] = {"t": np.repeat(view.time, each)}
    for name, is_broad in _drawn(columns):
        place = columns.index(name)
        low, high = view.low[:, place], view.high[:, place]
        data[name] = np.stack([low, high], axis=1)[:, :each].ravel()
        if is_broad:
            calm = high - low <= _CALM * span[place]
            data[broad_name(name)] = np.repeat(np.where(calm, low, np.nan), each)
    return data


def _drawn(columns: Sequence[str]) -> list[tuple[str, bool]]:
    """Columns with a curve, and whether it is broad: where several lie over each other."""
    return [(name, len(group) > 1) for group in groups_of(columns) for name in group]


def flag_marks(view: View) -> dict[str, list[Any]]:
    """Times, names and colors of a view's flags."""
    marks: dict[str, list[Any]] = {"time": [], "flag": [], "color": []}
    for flag, color in FLAG_COLORS.items():
        at = view.time[(view.flags & int(flag)) != 0].tolist()
        marks["time"] += at
        marks["flag"] += [flag_name(flag)] * len(at)
        marks["color"] += [color] * len(at)
    return marks


def lines_at(
    flags: Mapping[str, Any], mark: float | None, trigger: float | None = None
) -> dict[str, list[Any]]:
    """Lines across all figures: where a grave flag stands, at the mark and at the trigger."""
    flagged = zip(flags["time"], flags["flag"], strict=True)
    grave = sorted({time for time, name in flagged if name in _GRAVE})
    lines = [(time, RED, "solid") for time in grave]
    lines += [
        (at, color, "dashed") for at, color in ((mark, "black"), (trigger, GREEN)) if at is not None
    ]
    names = ("time", "color", "dash")
    return {name: [line[k] for line in lines] for k, name in enumerate(names)}


def _curve_figure(group: Sequence[str], sources: Sources, time: Range1d, cursor: Span) -> figure:
    plot = _empty(time, cursor, 108, Range1d(start=0.0, end=0.0))
    unit = UNITS.get(group[-1])
    label = quantity_of(group[-1]).replace("_", " ")
    plot.yaxis.axis_label = label + (f"\n[{unit}]" if unit else "")
    plot.yaxis.ticker = BasicTicker(desired_num_ticks=4)  # with three there may be but one
    # A line of one pixel costs a browser without a graphics card a tenth of one of 1.2 pixels.
    for column in group:
        color = color_of(column)
        if len(group) > 1:
            # A pixel of blue over orange is olive: two are blue, with orange on both sides.
            width = _BROAD if is_wanted(column) else _BROAD_ABOVE
            _draw(plot, sources.samples, column, broad_name(column), color, width)
        _draw(plot, sources.samples, column, column, color)
    plot.name, plot.tags = f"figure of {label}", list(group)
    return plot


def _draw(
    plot: figure, source: ColumnDataSource, column: str, name: str, color: str, width: float = 1.0
) -> Any:
    look: dict[str, Any] = {"source": source, "line_color": color, "line_width": width}
    if column.startswith(("cmd_", "applied_")):  # held from a sample to the next
        return plot.step("t", name, mode="after", **look)
    return plot.line("t", name, **look)


def _flag_strip(sources: Sources, time: Range1d, cursor: Span) -> figure:
    names = [flag_name(flag) for flag in FLAG_COLORS]
    plot = _empty(time, cursor, 110, FactorRange(factors=names[::-1]))
    plot.yaxis.axis_label = "flags"
    plot.scatter("time", "flag", source=sources.flags, marker="square", size=7, color="color")
    return plot


def _empty(time: Range1d, cursor: Span, height: int, y_range: Any) -> figure:
    plot = figure(
        title=None, height=height, x_range=time, y_range=y_range,
        tools="xbox_zoom,xpan,xwheel_zoom,reset,save", active_scroll="xwheel_zoom",
        active_drag="xbox_zoom",
    )  # fmt: skip
    plot.update(min_border_left=95, min_border_bottom=6)
    plot.add_tools(CrosshairTool(overlay=cursor))
    plot.yaxis.axis_label_text_font_style = "normal"
    plot.outline_line_color = "#cccccc"
    return plot
