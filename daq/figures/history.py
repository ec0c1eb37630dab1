"""Several runs in one figure: their signals over each other, parameters over the runs' dates."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import FloatArray

_SIGNAL, _TREND = 0.62, 0.48  # in, heights of panels
_GAP, _ABOVE, _BETWEEN = 0.13, 0.2, 0.62  # in, between signals, parameters, and both
_DATES = 6  # marks of the axis of dates at most
_CROWD = 60  # runs, from which on their marks would run together


@dataclass(frozen=True)
class Overlay:
    """One signal of several runs: by run its times [s] and values, (n_samples,) each."""

    name: str
    unit: str
    lines: Mapping[str, tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Trend:
    """A parameter of several runs: when each began, and (n_runs, 3) value, low and high end.

    NaN stands for an end that the data did not set.
    """

    name: str
    unit: str
    dates: Sequence[datetime.datetime]
    values: FloatArray


@style.styled
def history(overlays: Sequence[Overlay], trends: Sequence[Trend]) -> Figure:
    """Signals over time, at least one, then parameters with their 95 % intervals over the dates."""
    heights = [_SIGNAL] * len(overlays) + [_TREND] * len(trends)
    gaps = [_GAP] * (len(overlays) - 1) + [_BETWEEN] + [_ABOVE] * (len(trends) - 1)
    top = style.legend_room(list(overlays[0].lines)) + 0.06
    figure, axes = style.stack(heights, gaps[: len(heights) - 1], top=top, share_x=False)
    panels = axes[: len(overlays)], axes[len(overlays) :]
    for axis, overlay in zip(panels[0], overlays, strict=True):
        _draw_overlay(axis, overlay)
    for axis, trend in zip(panels[1], trends, strict=True):
        _draw_trend(axis, trend)
    for group in panels:
        for axis in group[1:]:
            axis.sharex(group[0])
        for axis in group[:-1]:
            axis.tick_params(labelbottom=False)
    if panels[0]:
        panels[0][-1].set_xlabel("time [s]")
    if panels[1]:  # what the dates have in common stands at the axis's right end
        panels[1][-1].set_xlabel("date of the run (UTC)", loc="left")
    style.legend(figure, axes[0])
    return figure


@style.styled
def narrowing(seconds: FloatArray, names: Sequence[str], widths: FloatArray) -> Figure:
    """Half widths of intervals [%] after so many logged seconds, (n_rounds, n_names)."""
    seen = np.flatnonzero(np.isfinite(widths).any(axis=0))
    labels = [notation.label(names[int(place)]) for place in seen]
    figure, (panel,) = style.stack([2.4], top=style.legend_room(labels))
    for place, (label, width) in enumerate(zip(labels, widths.T[seen], strict=True)):
        panel.plot(
            seconds, width, marker="o", ms=2.8, lw=0.9, label=label,
            color=style.CYCLE[place % len(style.CYCLE)],
            ls=style.DASHES[place // len(style.CYCLE) % len(style.DASHES)],
        )  # fmt: skip
    style.logarithmic(panel.yaxis, widths)
    panel.set_xlabel("logged time [s]")
    style.name_y(panel, "half width of 95 % interval", "[%]")
    style.legend(figure, panel)
    return figure


def _draw_overlay(axis: Axes, overlay: Overlay) -> None:
    for place, (name, (time, values)) in enumerate(overlay.lines.items()):
        axis.plot(
            *style.thinned(time, values), label=name, lw=0.7,
            color=style.CYCLE[place % len(style.CYCLE)],
            ls=style.DASHES[place // len(style.CYCLE) % len(style.DASHES)],
        )  # fmt: skip
    style.name_y(axis, notation.words(overlay.name), notation.bracketed(overlay.unit))
    axis.margins(x=0.01)


def _draw_trend(axis: Axes, trend: Trend) -> None:
    when: FloatArray = date2num(list(trend.dates))  # type: ignore[no-untyped-call]
    value, low, high = trend.values.T
    bars = np.nan_to_num(np.vstack([value - low, high - value]), nan=0.0)
    thin = len(when) > _CROWD
    axis.errorbar(
        when, value, yerr=np.maximum(bars, 0.0), fmt="o", ms=1.2 if thin else 2.8,
        capsize=0.0 if thin else 2.0, elinewidth=0.3 if thin else 1.0,
        color=style.IDENTIFIED, ecolor=style.BASELINE,
    )  # fmt: skip
    # Above the panel: a combination's name would not stand upright beside it.
    name = f"{notation.label(trend.name)} {notation.bracketed(trend.unit)}"
    axis.text(0.0, 1.04, name, transform=axis.transAxes, va="bottom")
    axis.yaxis.set_major_formatter(style.tick)
    # With at least two marks there is a step for every span.
    locator = AutoDateLocator(minticks=2, maxticks=_DATES)  # type: ignore[no-untyped-call]
    axis.xaxis.set_major_locator(locator)
    formatter = ConciseDateFormatter(locator, tz=datetime.UTC)  # type: ignore[no-untyped-call]
    axis.xaxis.set_major_formatter(formatter)
    axis.margins(x=0.06, y=0.15)
    if np.ptp(when) == 0.0:  # an hour about one instant, not years
        axis.set_xlim(when[0] - 0.04, when[0] + 0.04)
