"""One quantity over each of several others, such as a torque over angle and over speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from daq import notation
from daq.figures import style
from daq.figures.style import FloatArray
from daq.findings import Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 700


@style.styled
def plot(
    over: Sequence[Axis],
    quantity: Axis,
    curves: Mapping[str, Mapping[str, FloatArray]],
    points: bool = False,
) -> Figure:
    """A panel for each quantity in ``over``; curves: by label, values by the axes' labels, (n,).

    points: curves are clouds of measured samples.
    """
    figure, panels = style.stack(
        [1.45] * len(over), 0.42, top=style.legend_room(list(curves)), share_x=False
    )
    for panel, axis in zip(panels, over, strict=True):
        for k, (label, values) in enumerate(curves.items()):
            # Of a long cloud of points a part looks the same.
            stride = 1 + len(values[axis.label]) // _POINTS if points else 1
            x, y = values[axis.label][::stride], values[quantity.label][::stride]
            panel.plot(x, y, label=label, **_look(k, points))
        panel.set_xlabel(f"{axis.label} {notation.bracketed(axis.unit)}", labelpad=1.5)
        style.name_y(panel, quantity.label, notation.bracketed(quantity.unit))
    style.legend(figure, panels[0])
    return figure


def _look(k: int, points: bool) -> dict[str, Any]:
    colour = style.CYCLE[k % len(style.CYCLE)]
    if not points:
        return {"color": colour, "ls": style.DASHES[k % len(style.DASHES)]}
    marker = "ox^s"[k % 4]
    return {"ls": "", "marker": marker, "ms": 1.4, "mew": 0.3, "mfc": "none", "color": colour}
