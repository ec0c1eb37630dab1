"""How the error fell during a search."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
