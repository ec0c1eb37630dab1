"""What is left in the residuals: their own past, and the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Remainder:
    """Correlations of one output's residuals over lags, (n_lags,), and half their 95 % bands.

    cross: by input, its correlation and band.
    """

    name: str
    auto: FloatArray
    band: float
    cross: Mapping[str, tuple[FloatArray, float]]


@style.styled
def residual_correlations(lags: FloatArray, outputs: Sequence[Remainder]) -> Figure:
    """Each output's correlation with its past and with the inputs, in parts of their 95 % bands.

    lags: seconds. Inside ±1 is what chance alone leaves, 95 times in 100.
    """
    labels = ["with its past", *(f"with {name}" for name in outputs[0].cross)]
    figure, panels = style.stack([0.85] * len(outputs), 0.14, top=style.legend_room(labels))
    for panel, output in zip(panels, outputs, strict=True):
        panel.axhspan(-1.0, 1.0, color="#eeeeee", lw=0, zorder=0)
        panel.axhline(0.0, color="black", lw=0.4, zorder=1)
        panel.plot(lags[1:], output.auto[1:] / output.band, color=style.MEASURED,
                   lw=0.8, label="with its past")  # fmt: skip
        for k, (name, (values, band)) in enumerate(output.cross.items()):
            panel.plot(lags, values / band, color=style.CYCLE[k % len(style.CYCLE)],
                       ls=style.DASHES[k % len(style.DASHES)], lw=0.8,
                       label=f"with {notation.words(name)}")  # fmt: skip
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, -1.5), max(high, 1.5))
        style.name_y(panel, notation.words(output.name), "[1]")
        panel.margins(x=0.01)
    panels[-1].set_xlabel("lag [s]")
    style.legend(figure, panels[0])
    return figure
