"""Frequency responses: measured, of a model treated likewise, and of linear models."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from daq import notation
from daq.figures import style
from daq.hal import BoolArray, FloatArray

ComplexArray = npt.NDArray[np.complex128]
_MEASURED, _IDENTIFIED = "measured, 95 %", "identified"
_Z95 = 1.959963984540054


@style.styled
def bode(
    frequency: FloatArray,
    response: ComplexArray,
    coherence: FloatArray,
    deviation: FloatArray,
    significant: BoolArray,
    identified: ComplexArray | None,
    band: FloatArray,
    linear: Mapping[str, ComplexArray],
    units: tuple[str, str],
) -> Figure:
    """Magnitude, phase and coherence over frequencies [Hz], (n,).

    response, coherence, deviation: as estimated, (n,), with a magnitude's standard deviation.
    significant: (n,), where they are more than noise; other points are left out. identified: of
    the model, by the same estimate, with the same gaps. linear: of linear models by name, at the
    frequencies ``band`` [Hz], (m,). units: of output and input. Measured magnitudes carry 95 %
    bars. Phases do not jump by a turn where there is a linear model to go by.
    """
    estimates = {} if identified is None else {_IDENTIFIED: identified}
    names = [*estimates, *linear]
    figure, (size, angle, seen) = style.stack(
        [1.1, 0.8, 0.45], 0.1, top=style.legend_room([_MEASURED, *names])
    )
    magnitude = np.abs(response)
    smooth = _smooth_phase(linear)
    phase = _phase(response, frequency, band, smooth)
    at, heights = frequency[significant], magnitude[significant]
    bars = _Z95 * deviation[significant]
    size.errorbar(
        at, heights, yerr=[np.minimum(bars, 0.98 * heights), bars], fmt="none",
        ecolor=style.MEASURED, elinewidth=0.4,
    )  # fmt: skip
    size.plot(at, heights, ".", ms=2.5, color=style.MEASURED, label=_MEASURED)
    angle.plot(at, phase[significant], ".", ms=2.5, color=style.MEASURED)
    phases = [phase[significant]]
    drawn = [(frequency, np.where(significant, each, np.nan)) for each in estimates.values()]
    drawn += [(band, each) for each in linear.values()]
    for k, (name, (points, curve)) in enumerate(zip(names, drawn, strict=True)):
        look = {"color": style.CYCLE[(1, 0, 2, 3)[k % 4]], "ls": style.DASHES[k % 4]}
        size.plot(points, np.abs(curve), label=name, **look)  # type: ignore[arg-type]
        phases.append(_phase(curve, points, band, smooth))
        angle.plot(points, phases[-1], **look)  # type: ignore[arg-type]
    limits = _limits(heights, [*estimates.values(), *linear.values()])
    size.set_ylim(*limits)
    style.logarithmic(size.yaxis, np.array(limits))
    shown = np.concatenate(phases)
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


def _smooth_phase(linear: Mapping[str, ComplexArray]) -> FloatArray | None:
    """Phase [degrees] of the last linear model, without jumps by a turn; None without one."""
    *_, last = [None, *linear.values()]
    return None if last is None else np.unwrap(np.angle(last, deg=True), period=360.0)


def _phase(
    response: ComplexArray, frequency: FloatArray, band: FloatArray, smooth: FloatArray | None
) -> FloatArray:
    """Phase [degrees], of the turns that one may choose from that which is near the smooth one."""
    phase: FloatArray = np.angle(response, deg=True)
    if smooth is None:
        return phase
    near = np.interp(frequency, band, smooth)
    return phase + 360.0 * np.round((near - phase) / 360.0)


def _limit_phase(angle: Axes, degrees: FloatArray) -> None:
    low, high = (degrees.min(), degrees.max()) if len(degrees) else (-180.0, 180.0)
    first, last = np.floor(low / 90.0), np.ceil(high / 90.0)
    step = max(1.0, np.ceil((last - first) / 4.0))
    ticks = 90.0 * np.arange(first, last + step, step)
    angle.set_yticks(ticks)
    angle.set_ylim(ticks[0] - 10.0, ticks[-1] + 10.0)


def _limits(magnitude: FloatArray, curves: Sequence[ComplexArray]) -> tuple[float, float]:
    """Limits by what is credible: neither bars that reach to zero nor a curve's notch."""
    middles = [float(np.median(np.abs(values))) for values in curves]
    every = np.concatenate([magnitude[magnitude > 0.0], [m for m in middles if m > 0.0]])
    if not len(every):
        return 0.1, 1.0
    return 0.4 * float(every.min()), 2.5 * float(every.max())


def _ratio(output: str, given: str) -> str:
    above, below = notation.unit_text(output) or "1", notation.unit_text(given)
    if not below:
        return above
    return f"({above})/{below}" if "/" in above else f"{above}/{below}"
