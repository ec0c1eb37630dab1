"""Frequency responses: measured, of a model treated likewise, and of linear models."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import FloatArray

ComplexArray = npt.NDArray[np.complex128]
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
    magnitudes carry 95 % bars; points of low coherence are faint.
    """
    figure, (size, angle, seen) = style.stack(
        [1.1, 0.8, 0.45], 0.1, top=style.legend_room([_MEASURED, *curves])
    )
    magnitude = np.abs(response)
    good = coherence >= _SEEN
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
        degrees = np.angle(response[chosen], deg=True)
        angle.plot(frequency[chosen], degrees, ".", ms=2.5, color=colour)
    for k, (name, curve) in enumerate(curves.items()):
        look = {"color": style.CYCLE[(1, 0, 2, 3)[k % 4]], "ls": style.DASHES[k % 4]}
        size.plot(frequency, np.abs(curve), label=name, **look)  # type: ignore[arg-type]
        angle.plot(frequency, np.angle(curve, deg=True), **look)  # type: ignore[arg-type]
    limits = _limits(magnitude, good, curves)
    size.set_ylim(*limits)
    style.logarithmic(size.yaxis, np.array(limits))
    angle.set_ylim(-190, 190)
    angle.set_yticks([-180, -90, 0, 90, 180])
    seen.plot(frequency, coherence, color=style.MEASURED, lw=0.8)
    seen.set_ylim(-0.05, 1.05)
    style.logarithmic(seen.xaxis, frequency)
    seen.set_xlabel("frequency [Hz]")
    style.name_y(size, "magnitude", f"[{_ratio(*units)}]")
    style.name_y(angle, "phase", "[°]")
    style.name_y(seen, "coherence", "[1]")
    style.legend(figure, size)
    return figure


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
