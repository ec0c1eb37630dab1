"""What a design will do and tell: commands, signals against their limits, intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import FloatArray

_ROW = 0.15  # in, of a quantity


@dataclass(frozen=True)
class Prediction:
    """A signal of all runs, one after the other: at the likeliest parameters, and over all draws.

    line, low, high: (n_samples,). limits: its ends, None where there is none.
    """

    name: str
    unit: str
    line: FloatArray
    low: FloatArray
    high: FloatArray
    limits: tuple[float | None, float | None] = (None, None)
    steps: bool = False


@style.styled
def design(
    time: FloatArray,
    breaks: Sequence[float],
    predictions: Sequence[Prediction],
    intervals: Mapping[str, tuple[float, float, float | None]],
) -> Figure:
    """Predicted signals over the time of all runs [s], and intervals before and after.

    breaks: where a run ends and the next begins [s]. intervals: half widths in per cent of the
    value before and after, and the one that was asked for, by quantity; without any there is no
    panel of them.
    """
    heights, gaps = [0.62] * len(predictions), [0.13] * (len(predictions) - 1)
    if intervals:
        heights, gaps = [*heights, _ROW * len(intervals) + 0.1], [*gaps, 0.55]
    labels, left = style.row_names(list(intervals))
    figure, axes = style.stack(heights, gaps, left=max(left, style.LEFT), share_x=False)
    panels = axes[: len(predictions)]
    for panel, prediction in zip(panels, predictions, strict=True):
        _predicted(panel, time, breaks, prediction)
        panel.tick_params(labelbottom=panel is panels[-1])
    panels[-1].set_xlabel("logged time [s]")
    style.legend(figure, panels[-1])
    if intervals:
        _intervals(axes[-1], labels, np.array([(b, a) for b, a, _ in intervals.values()]),
                   [target for _, _, target in intervals.values()])  # fmt: skip
    return figure


def _predicted(
    panel: Axes, time: FloatArray, breaks: Sequence[float], prediction: Prediction
) -> None:
    drawstyle = "steps-post" if prediction.steps else "default"
    if not np.array_equal(prediction.low, prediction.high):
        low, high = prediction.low, prediction.high
        panel.fill_between(time, low, high, color=style.FAINT, lw=0.0, label="plausible")
    panel.plot(*style.thinned(time, prediction.line), color=style.IDENTIFIED, lw=0.7,
               drawstyle=drawstyle, label="likeliest")  # fmt: skip
    for end in prediction.limits:
        if end is not None:
            panel.axhline(end, color="black", lw=0.6, ls="--", label="limit")
    for end in breaks:
        panel.axvline(end, color=style.FAINT, lw=0.4, zorder=0)
    style.name_y(panel, notation.words(prediction.name), notation.bracketed(prediction.unit))
    panel.margins(x=0.01)


def _intervals(
    panel: Axes, labels: Sequence[str], widths: FloatArray, targets: Sequence[float | None]
) -> None:
    rows = np.arange(len(labels))
    panel.plot(widths[:, 0], rows, "o", ms=3.0, mfc="white", mec=style.MEASURED, label="before")
    panel.plot(widths[:, 1], rows, "o", ms=3.0, color=style.IDENTIFIED, label="after")
    for row, (before, after) in enumerate(widths.tolist()):
        panel.plot([before, after], [row, row], color=style.FAINT, lw=0.8, zorder=1)
    for row, target in enumerate(targets):
        if target is not None:
            panel.plot(target, row, "|", ms=6.0, color="black", mew=1.0)
    panel.set_yticks(rows, labels)
    panel.set_ylim(len(labels) - 0.4, -0.6)
    style.logarithmic(panel.xaxis, np.append(widths, [t for t in targets if t is not None]))
    panel.grid(visible=False, axis="y")
    panel.set_xlabel("95 % half width, before (open) and after [%]")
