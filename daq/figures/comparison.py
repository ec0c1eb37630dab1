"""Measured beside simulated outputs, what is left between them below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from daq.hal import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def measured_and_simulated(
    time: FloatArray,
    measured: FloatArray,
    simulated: FloatArray,
    outputs: Sequence[tuple[str, str]],
    fit: FloatArray,
) -> Figure:
    """A panel for each output and its residual below.

    time: (n,) [s]. measured, simulated: (n, n_outputs). outputs: name and unit of each. fit:
    (n_outputs,) [%].
    """
    from matplotlib.figure import Figure

    q = len(outputs)
    drawn = Figure(figsize=(6.0, 2.2 * q + 0.6), dpi=150, layout="constrained")
    axes = drawn.subplots(2 * q, 1, sharex=True, height_ratios=[3, 1] * q, squeeze=False)[:, 0]
    for j, (name, unit) in enumerate(outputs):
        above, below = axes[2 * j], axes[2 * j + 1]
        above.plot(time, measured[:, j], color="0.55", linewidth=1.0, label="measured")
        above.plot(time, simulated[:, j], color="#0072b2", linewidth=1.0,
                   label=f"simulated, fit {fit[j]:.1f} %")  # fmt: skip
        above.set_ylabel(f"{name} [{unit}]")
        above.legend(loc="upper right", fontsize="x-small")
        below.plot(time, measured[:, j] - simulated[:, j], color="#d55e00", linewidth=0.6)
        below.set_ylabel("residual")
    axes[-1].set_xlabel("time [s]")
    drawn.align_ylabels()
    return drawn
