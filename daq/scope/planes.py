"""What is not drawn over time: torque over speed or angle, and spectra."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, LogTicker
from bokeh.models.widgets import Div
from bokeh.plotting import figure

from daq.hal import FloatArray
from daq.logs.columns import UNITS
from daq.scope.looks import BLUE, groups_of, quantity_of

TIME, SPECTRUM = "time", "spectrum"
_XY = {"torque–speed": ("omega", "torque"), "torque–angle": ("theta", "torque")}
VIEWS = (TIME, *_XY, SPECTRUM)
_POINTS = 4000  # of a figure, at most
_SAMPLES = 65_536  # that are looked at
_SEGMENT = 8192  # samples, at most, of a spectrum's segment


@dataclass(frozen=True)
class PlaneSources:
    """What is drawn of one run, in its color."""

    xy: ColumnDataSource
    spectra: ColumnDataSource
    color: str

    @classmethod
    def of(cls, color: str, xy: str | None = None, spectra: str | None = None) -> Self:
        """Sources without data yet, under names by which they are found."""
        sources = ColumnDataSource({"x": [], "y": []}), ColumnDataSource({"f": []})
        for source, name in zip(sources, (xy, spectra), strict=True):
            source.name = name
        return cls(*sources, color)


class Planes:
    """The figures of one view at a time, and their data."""

    def __init__(self) -> None:
        self.shown = PlaneSources.of(BLUE, "xy", "spectra")

    def layout(
        self,
        view: str,
        columns: Sequence[str],
        chosen: Collection[str],
        others: Sequence[PlaneSources] = (),
    ) -> Any:
        """The figures of a view; a sentence where the log lacks what it needs.

        others: of runs behind the one that is shown.
        """
        runs = [*others, self.shown]
        if view in _XY:
            x, y = _XY[view]
            if x not in columns or y not in columns:
                return Div(text=f"This log has no {x} or no {y}.")
            return _xy_figure(runs, x, y)
        names = _drawn(columns, chosen)
        for run in runs:
            run.spectra.data = {"f": np.zeros(0), **{name: np.zeros(0) for name in names}}
        if not names:
            return Div(text="No channel is chosen.")
        plots = [_spectrum_figure(runs, name) for name in names]
        for plot in plots[:-1]:
            plot.x_range = plots[-1].x_range
            plot.below = []
        plots[-1].xaxis.axis_label = "f [Hz]"
        plots[-1].height = (plots[-1].height or 0) + 45
        return gridplot(
            [[plot] for plot in plots], toolbar_location="above", sizing_mode="stretch_width",
            toolbar_options={"logo": None},
        )  # fmt: skip

    def draw(
        self,
        view: str,
        columns: Sequence[str],
        chosen: Collection[str],
        rows: FloatArray,
        dt: float,
        run: PlaneSources | None = None,
        quantities: Sequence[str] | None = None,
    ) -> None:
        """Show neighbouring rows, (n, n_columns), ``dt`` apart [s].

        run: another one than that which is shown; then quantities: the columns of that.
        """
        run = self.shown if run is None else run
        if view in _XY and all(name in columns for name in _XY[view]):
            step = max(1, -(-len(rows) // _POINTS))
            x, y = (rows[::step, columns.index(name)] for name in _XY[view])
            run.xy.data = {"x": x, "y": y}
        elif view == SPECTRUM and dt > 0.0:
            names = _drawn(columns if quantities is None else quantities, chosen)
            blank = np.full((len(rows), 1), np.nan)
            places = [columns.index(name) if name in columns else -1 for name in names]
            frequency, amplitudes = spectra(np.hstack([rows, blank])[:, places], dt)
            amplitude_of = dict(zip(names, amplitudes.T, strict=True))
            run.spectra.data = {"f": frequency, **amplitude_of}

    @property
    def most(self) -> int:
        """Rows that are looked at, at most."""
        return _SAMPLES


def spectra(values: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies [Hz] and amplitudes (n_frequencies, n_channels) of channels (n, n_channels).

    By Welch's method (1967): Hann windows that overlap by half, their powers averaged, without the
    mean; a sine of amplitude 1 gives 1. Empty for fewer than 16 samples; what was not measured
    counts as the mean.

    >>> t = np.arange(4096) / 1000.0
    >>> frequency, amplitude = spectra(3.0 * np.sin(2.0 * np.pi * 125.0 * t)[:, None], 1e-3)
    >>> float(frequency[amplitude[:, 0].argmax()]), round(float(amplitude.max()), 2)
    (125.0, 3.0)
    """
    n = min(len(values), _SEGMENT)
    if n < 16:
        return np.zeros(0), np.zeros((0, values.shape[1]))
    length = 1 << (n.bit_length() - 1)
    measured = np.isfinite(values)
    mean = np.where(measured, values, 0.0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)
    centred = np.where(measured, values - mean, 0.0)
    window = np.hanning(length + 1)[:-1]
    begins = range(0, len(values) - length + 1, length // 2)
    powers = [
        np.abs(np.fft.rfft(window[:, None] * centred[k : k + length], axis=0)) ** 2 for k in begins
    ]
    amplitude: FloatArray = 2.0 / window.sum() * np.sqrt(np.mean(powers, axis=0))
    frequency: FloatArray = np.arange(length // 2 + 1) / (length * dt)
    return frequency[1:], amplitude[1:]


def _drawn(columns: Sequence[str], chosen: Collection[str]) -> list[str]:
    """Of each chosen quantity the column of what came of it."""
    return [group[-1] for group in groups_of(columns) if quantity_of(group[-1]) in chosen]


def _xy_figure(runs: Sequence[PlaneSources], x: str, y: str) -> figure:
    plot = figure(
        height=520, sizing_mode="stretch_width", tools="pan,box_zoom,wheel_zoom,reset,save",
        x_axis_label=f"{x} [{UNITS[x]}]", y_axis_label=f"{y} [{UNITS[y]}]", name="figure of xy",
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.toolbar_location = "above"
    for run in runs:
        plot.line("x", "y", source=run.xy, line_color=run.color, line_width=1.0)
    return plot


def _spectrum_figure(runs: Sequence[PlaneSources], name: str) -> figure:
    plot = figure(
        height=150, x_axis_type="log", y_axis_type="log",
        tools="xpan,box_zoom,xwheel_zoom,reset,save", name=f"spectrum of {name}",
    )  # fmt: skip
    unit = UNITS.get(name)
    label = quantity_of(name).replace("_", " ")
    plot.yaxis.axis_label = label + (f"\n[{unit}]" if unit else "")
    plot.yaxis.axis_label_text_font_style = "normal"
    plot.yaxis.ticker = LogTicker(desired_num_ticks=3)
    plot.min_border_left = 95
    for run in runs:
        plot.line("f", name, source=run.spectra, line_color=run.color, line_width=1.0)
    return plot
