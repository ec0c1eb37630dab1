"""How much larger other models' errors are than the best one's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daq import notation
from daq.figures import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAME = 52  # letters of a name above its row


@dataclass(frozen=True)
class Ratio:
    """A model's squared errors in parts of the best one's, with their 95 % interval."""

    name: str
    value: float
    low: float
    high: float


@style.styled
def ratios(best: str, others: Sequence[Ratio]) -> Figure:
    """A row for each model, the best at 1; an interval that reaches 1 tells no difference."""
    rows = [Ratio(best, 1.0, 1.0, 1.0), *others]
    figure, (panel,) = style.stack([0.3 * len(rows)], left=0.15, top=0.1)
    panel.axvline(1.0, color="black", lw=0.4, zorder=1)
    for place, ratio in enumerate(rows):
        bars = [[ratio.value - ratio.low], [ratio.high - ratio.value]]
        look: dict[str, Any] = {
            "color": style.IDENTIFIED,
            "ecolor": style.BASELINE,
            "elinewidth": 1.2,
        }
        panel.errorbar(ratio.value, place, xerr=bars, fmt="o", ms=3.0, capsize=2.0, **look)
        name = ratio.name if len(ratio.name) <= _NAME else f"{ratio.name[: _NAME - 1]}…"
        panel.text(0.01, place - 0.28, name.replace("$", r"\$"), fontsize=6.0, va="center",
                   bbox={"fc": "white", "ec": "none", "pad": 0.3},
                   transform=panel.get_yaxis_transform())  # fmt: skip
    ends = np.array([end for ratio in rows for end in (ratio.low, ratio.high)])
    panel.set_ylim(len(rows) - 0.5, -0.55)
    panel.set_xlim(0.9 * ends.min(), 1.1 * ends.max())
    style.logarithmic(panel.xaxis, ends)
    panel.set_yticks([])
    panel.spines["left"].set_visible(False)
    panel.set_xlabel(f"squared errors in validation, best model = 1 {notation.bracketed('1')}")
    return figure
