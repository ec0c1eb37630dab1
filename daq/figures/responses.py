"""Measured against simulated outputs, with what is left below each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_EXCESS = 4.0  # times the first model's residual that another's is drawn to
_LOOKS = (
    {"color": style.IDENTIFIED, "lw": 0.8, "zorder": 3},
    {"color": style.BASELINE, "lw": 0.6, "zorder": 2, "ls": (0, (3, 1))},
)


@dataclass(frozen=True)
class Response:
    """One output: measured, (n_samples,), NaN where lost, and simulated under several names.

    simulated: the model that the figure is about first. note: what stands above its panel.
    """

    name: str
    unit: str
    measured: FloatArray
    simulated: Mapping[str, FloatArray]
    note: str = ""


@style.styled
def responses(time: FloatArray, outputs: Sequence[Response]) -> Figure:
    """Each output's response and, at its own scale below, measured minus simulated."""
    heights = [height for _ in outputs for height in (0.78, 0.4)]
    gaps = [gap for _ in outputs for gap in (0.06, 0.26)][:-1]
    figure, axes = style.stack(heights, gaps, top=0.36)
    for j, output in enumerate(outputs):
        _draw(time, output, axes[2 * j], axes[2 * j + 1])
    axes[-1].set_xlabel("time [s]")
    style.legend(figure, axes[0])
    return figure


def _draw(time: FloatArray, output: Response, above: Axes, below: Axes) -> None:
    unit = notation.bracketed(output.unit)
    above.plot(*style.thinned(time, output.measured), color=style.MEASURED, lw=1.5,
               label="measured")  # fmt: skip
    # The last of the looks serves all that are beyond it.
    for k, (name, values) in enumerate(output.simulated.items()):
        look = _LOOKS[min(k, len(_LOOKS) - 1)]
        above.plot(*style.thinned(time, values), label=name, **look)  # type: ignore[arg-type]
        left = output.measured - values
        below.plot(*style.thinned(time, left), **look)  # type: ignore[arg-type]
    # A model that runs away must flatten neither what was measured nor the other's residual.
    above.set_ylim(*_around(output))
    below.set_ylim(*_around_residual(output))
    below.axhline(0.0, color="black", lw=0.4, zorder=1)
    style.name_y(above, notation.words(output.name), unit)
    style.name_y(below, "residual", unit)
    for panel in (above, below):
        panel.margins(x=0.01)
    below.locator_params(axis="y", nbins=3)
    if output.note:
        style.note(above, output.note)


def _around(output: Response) -> tuple[float, float]:
    """Limits that hold the measured and the first simulated line."""
    first = next(iter(output.simulated.values()))
    values = np.concatenate([output.measured, first])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = 0.06 * (high - low) or 1.2
    return low - room, high + room


def _around_residual(output: Response) -> tuple[float, float]:
    """Limits that hold the first model's residual, and of the others' what that leaves room for."""
    sizes = []
    for values in output.simulated.values():
        left = np.abs(output.measured - values)
        sizes.append(float(np.max(left, where=np.isfinite(left), initial=0.0)))
    largest = 1.06 * min(max(sizes), _EXCESS * sizes[0]) or 1.2
    return -largest, largest
