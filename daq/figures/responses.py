"""Outputs as measured and as models simulate them, and what is left between the two."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.figures.signals import Panel, closer_look, with_closer
from daq.hal import FloatArray

_INSIDE = 0.04  # of a frame's height, from its edge to what marks a curve beyond
_PLAIN = 1e-2, 1e4  # sizes whose numbers need no power of ten
_MARKS = 15  # of a curve beyond its frame, at most about so many at an edge
_EXCESS = 4.0  # times the first model's residual that another's is drawn to
# Of the first simulated line and the second; further ones have colours of their own.
_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": style.IDENTIFIED, "lw": 0.8, "zorder": 3},
    {"color": style.BASELINE, "lw": 0.6, "zorder": 2, "ls": (0, (3, 1))},
)


@style.styled
def responses(time: FloatArray, outputs: Sequence[Panel]) -> Figure:
    """Each output's response and, at its own scale below, measured minus simulated.

    Of each panel's lines the first is the measured one, the second of the model that the figure
    is about. Of a record that swings too often to be read, ``closer_look`` is drawn beside it.
    """
    heights, gaps = [0.78, 0.4] * len(outputs), ([0.06, 0.26] * len(outputs))[:-1]
    figure, axes = style.stack(heights, gaps, top=0.36)
    views = with_closer(time, axes, closer_look(outputs))
    leaves = [
        _respond(time, output, [(part, panels[2 * j], panels[2 * j + 1]) for part, panels in views])
        for j, output in enumerate(outputs)
    ]
    if any(leaves):
        axes[0].plot([], [], ls="", marker="^", ms=3, color="0.4", label="beyond frame")
    for _, panels in views:
        panels[-1].set_xlabel("time [s]")
    style.legend(figure, axes[0])
    return figure


def _respond(time: FloatArray, output: Panel, views: Sequence[tuple[slice, Axes, Axes]]) -> bool:
    """One output in views of its samples, each of two panels; whether a curve leaves its frame."""
    measured, *simulated = output.lines.values()
    factor, unit = _multiple(_largest(measured), output.unit)
    measured, simulated = factor * measured, [factor * values for values in simulated]
    residuals = [measured - values for values in simulated]
    if residuals:
        smaller, unit_below = _multiple(_largest(residuals[0]) / factor, output.unit)
        residuals = [smaller / factor * residual for residual in residuals]
    else:
        unit_below = unit
    names = list(output.lines)[1:]
    looks = [
        _LOOKS[k] if k < len(_LOOKS) else {**_LOOKS[1], "color": f"C{k}"} for k in range(len(names))
    ]
    # A model that runs away must flatten neither what was measured nor the other's residual.
    values = np.concatenate([measured, simulated[0]])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = 0.06 * (high - low) or 1.2
    sizes = [_largest(residual) for residual in residuals]
    largest = 1.06 * min(max(sizes), _EXCESS * sizes[0]) or 1.2
    leaves = False
    for part, above, below in views:
        above.plot(
            *style.thinned(time[part], measured[part]), color=style.MEASURED, lw=1.5,
            label="measured",
        )  # fmt: skip
        for name, look, run, residual in zip(names, looks, simulated, residuals, strict=True):
            above.plot(*style.thinned(time[part], run[part]), label=name, **look)
            below.plot(*style.thinned(time[part], residual[part]), **look)
        above.set_ylim(low - room, high + room)
        below.set_ylim(-largest, largest)
        for panel, curves in ((above, simulated), (below, residuals)):
            panel.margins(x=0.01)
            for look, curve in zip(looks, curves, strict=True):
                leaves |= _mark_leaving(panel, time[part], curve[part], str(look["color"]))
        below.axhline(0.0, color="black", lw=0.4, zorder=1)
        below.locator_params(axis="y", nbins=3)
    _, above, below = views[0]
    style.name_y(above, notation.words(output.name), unit)
    style.name_y(below, "residual", unit_below)
    if output.note:
        views[-1][1].set_title(output.note, loc="right", fontsize=6.5, pad=2.0)
    return leaves


def _multiple(largest: float, unit: str) -> tuple[float, str]:
    """By what values are multiplied to need no power of ten at their axis; their unit there."""
    if not math.isfinite(largest) or largest == 0.0 or _PLAIN[0] <= largest < _PLAIN[1]:
        return 1.0, notation.bracketed(unit)
    factor, prefixed = notation.engineering(largest, unit)
    if factor != 1.0:
        return factor, notation.bracketed(prefixed)
    power = 3 * math.floor(math.log10(largest) / 3.0)
    text = notation.unit_text(unit)
    raised = notation.raised(str(power))
    return 10.0**-power, f"[10{raised} {text}]" if text not in ("", "1") else f"[10{raised}]"


def _mark_leaving(panel: Axes, time: FloatArray, values: FloatArray, color: str) -> bool:
    """Mark each stretch of a curve beyond its frame at the edge; whether there is one."""
    low, high = panel.get_ylim()
    there = ~np.isnan(values)  # what is missing parts no stretch
    time, values = time[there], values[there]
    inside, places = _INSIDE * (high - low), list[tuple[float, float, str]]()
    ends = ((values > high, high - inside, "^"), (values < low, low + inside, "v"))
    for beyond, edge, marker in ends:
        steps = np.flatnonzero(np.diff(np.concatenate([[False], beyond, [False]]).astype(int)))
        middles = time[(steps[::2] + steps[1::2] - 1) // 2]
        places += [(at, edge, marker) for at in middles[:: max(1, len(middles) // _MARKS)]]
    for marker in ("^", "v"):
        here = [(at, edge) for at, edge, kind in places if kind == marker]
        if here:
            panel.plot(*np.transpose(here), ls="", marker=marker, ms=2.5, color=color,
                       clip_on=False, scalex=False, scaley=False)  # fmt: skip
    return bool(places)


def _largest(residual: FloatArray) -> float:
    return float(np.max(np.abs(residual), where=np.isfinite(residual), initial=0.0))
