"""Torque over angle and over speed: hysteresis loops, and how torque follows speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POINTS = 700


@dataclass(frozen=True)
class Loop:
    """One curve: angle [rad], speed [rad/s] and torque [N*m], each (n_samples,)."""

    label: str
    angle: FloatArray
    speed: FloatArray
    torque: FloatArray


@style.styled
def hysteresis_loops(loops: Sequence[Loop], points: bool = False) -> Figure:
    """Torque over angle above, over speed below; ``points`` for measured samples."""
    figure, (over_angle, over_speed) = style.stack(
        [1.45, 1.45], 0.42, top=style.legend_room([loop.label for loop in loops]), share_x=False
    )
    for k, loop in enumerate(loops):
        look = _look(k, points)
        # Of a long cloud of points a part looks the same.
        some = slice(None, None, 1 + len(loop.torque) // _POINTS if points else 1)
        over_angle.plot(loop.angle[some], loop.torque[some], label=loop.label, **look)
        over_speed.plot(loop.speed[some], loop.torque[some], **look)
    _label(over_angle, "angle", "rad")
    _label(over_speed, "speed", "rad/s")
    style.legend(figure, over_angle)
    return figure


def _look(k: int, points: bool) -> dict[str, Any]:
    colour = style.CYCLE[k % len(style.CYCLE)]
    if points:
        return {"ls": "", "marker": "ox^s"[k % 4], "ms": 1.4, "mew": 0.3, "mfc": "none",
                "color": colour}  # fmt: skip
    return {"color": colour, "ls": style.DASHES[k % len(style.DASHES)]}


def _label(panel: Axes, name: str, unit: str) -> None:
    panel.set_xlabel(f"{name} {notation.bracketed(unit)}", labelpad=1.5)
    style.name_y(panel, "torque", notation.bracketed("N*m"))
