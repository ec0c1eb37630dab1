"""Frequency responses: measured, of a model treated likewise, and of linear models."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import FloatArray

ComplexArray = npt.NDArray[np.complex128]
ESTIMATED = "identified"  # of the curves: by the same estimate as the measured points
_MEASURED = "measured, 95 %"
_Z95 = 1.959963984540054
_SEEN = 0.3  # coherence below which a measured point is drawn faintly


@style.styled
def bode(
    frequency: FloatArray,
    response: ComplexArray,
    coherence: FloatArray,
    deviation: FloatArray,
    curves: Mapping[str, ComplexArray],
    units: tuple[str, str],
) -> Figure:
    """Magnitude, phase and coherence over frequencies [Hz], (n,).

    response, coherence, deviation: as estimated, (n,), with a magnitude's standard deviation.
    curves: responses at the same frequencies by name. units: of output and input. Measured
    magnitudes carry 95 % bars; points of low coherence are faint, and what was estimated from the
    logs with the same inputs (``ESTIMATED``) has gaps there. Phases do not jump by a
    turn where there is a linear model to go by.
    """
    figure, (size, angle, seen) = style.stack(
        [1.1, 0.8, 0.45], 0.1, top=style.legend_room([_MEASURED, *curves])
    )
    magnitude = np.abs(response)
    good = coherence >= _SEEN
    phases = _phases([response, *curves.values()], any(name != ESTIMATED for name in curves))
    for chosen, colour in ((~good, style.FAINT), (good, style.MEASURED)):
        if not chosen.any():
            continue
        bars = _Z95 * deviation[chosen]
        lower = np.minimum(bars, 0.98 * magnitude[chosen])
        size.errorbar(
            frequency[chosen], magnitude[chosen], yerr=[lower, bars], fmt="none",
            ecolor=colour, elinewidth=0.4,
        )  # fmt: skip
        size.plot(frequency[chosen], magnitude[chosen], ".", ms=2.5, color=colour,
                  label=_MEASURED if colour == style.MEASURED else None)  # fmt: skip
        angle.plot(frequency[chosen], phases[0][chosen], ".", ms=2.5, color=colour)
    for k, (name, curve) in enumerate(curves.items()):
        seen_there = good if name == ESTIMATED and good.any() else np.ones(len(good), dtype=bool)
        look = {"color": style.CYCLE[(1, 0, 2, 3)[k % 4]], "ls": style.DASHES[k % 4]}
        height = np.where(seen_there, np.abs(curve), np.nan)
        size.plot(frequency, height, label=name, **look)  # type: ignore[arg-type]
        turned = np.where(seen_there, phases[1 + k], np.nan)
        angle.plot(frequency, turned, **look)  # type: ignore[arg-type]
    limits = _limits(magnitude, good, curves)
    size.set_ylim(*limits)
    style.logarithmic(size.yaxis, np.array(limits))
    shown = np.concatenate([phases[0][good], *phases[1:]])
    _limit_phase(angle, shown[np.isfinite(shown)])
    seen.plot(frequency, coherence, color=style.MEASURED, lw=0.8)
    seen.set_ylim(-0.05, 1.05)
    style.logarithmic(seen.xaxis, frequency)
    seen.set_xlabel("frequency [Hz]")
    style.name_y(size, "magnitude", f"[{_ratio(*units)}]")
    style.name_y(angle, "phase", "[°]")
    style.name_y(seen, "coherence", "[1]")
    style.legend(figure, size)
    return figure


def _phases(responses: Sequence[ComplexArray], go_on: bool) -> list[FloatArray]:
    """Phases [degrees]; go_on: the last does not jump by a turn, and the others keep near it."""
    phases = [np.angle(np.nan_to_num(response), deg=True) for response in responses]
    if not go_on:
        return phases
    smooth = np.unwrap(phases[-1], period=360.0)
    return [each + 360.0 * np.round((smooth - each) / 360.0) for each in phases]


def _limit_phase(angle: Axes, degrees: FloatArray) -> None:
    low, high = (degrees.min(), degrees.max()) if len(degrees) else (-180.0, 180.0)
    first, last = np.floor(low / 90.0), np.ceil(high / 90.0)
    step = max(1.0, np.ceil((last - first) / 4.0))
    ticks = 90.0 * np.arange(first, last + step, step)
    angle.set_yticks(ticks)
    angle.set_ylim(ticks[0] - 10.0, ticks[-1] + 10.0)


def _limits(
    magnitude: FloatArray, good: npt.NDArray[np.bool_], curves: Mapping[str, ComplexArray]
) -> tuple[float, float]:
    """Limits by what is credible: neither bars that reach to zero nor a curve's notch."""
    credible = magnitude[good] if good.any() else magnitude
    middles = [float(np.median(np.abs(values))) for values in curves.values()]
    every = np.concatenate([credible[credible > 0.0], [m for m in middles if m > 0.0]])
    if not len(every):
        return 0.1, 1.0
    return 0.4 * float(every.min()), 2.5 * float(every.max())


def _ratio(output: str, given: str) -> str:
    above, below = notation.unit_text(output) or "1", notation.unit_text(given)
    if not below:
        return above
    return f"({above})/{below}" if "/" in above else f"{above}/{below}"
