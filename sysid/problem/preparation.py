"""Preparing a record: filtered and late channels, offsets and drifts, more samples than needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, exp
from typing import Literal

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ModelError, Output, ProcessModel

_STOPPED = 60.0  # dB by which the filter stops what would fold into its passband
_PASSED = 0.75  # of the new Nyquist frequency, up to which nothing that was above is left
_WHOLE = 0.01  # of a sample that a delay may be off a whole number of them
_LONGEST = 0.1  # of a record, for a filter that is taken out
_KNOWN = 0.9  # of the filter's weight that must lie on samples that were measured


class PreparationError(ModelError):
    """A preparation that a record cannot have; key: which."""

    def __init__(self, key: tuple[str, ...], problem: str) -> None:
        super().__init__(f"{'.'.join(key)}: {problem}")
        self.key, self.problem = key, problem


@dataclass(frozen=True)
class Preparation:
    """What is done to a record before it is used, in this order; channels by the model's names.

    delay: seconds by which a channel comes late. detrend: what is taken off a channel, its mean
    (``constant``) or a straight line (``linear``). decimate: samples of which one is left, behind
    a low-pass of linear phase that all channels share. filtered: time constants [s] of filters of
    first order through which channels were logged, taken out before all else.

    >>> Preparation(decimate=10).needed
    True
    """

    delay: Mapping[str, float] = field(default_factory=dict)
    detrend: Mapping[str, Literal["constant", "linear"]] = field(default_factory=dict)
    decimate: int = 1
    filtered: Mapping[str, float] = field(default_factory=dict)

    @property
    def needed(self) -> bool:
        """Whether anything is to be done."""
        return bool(self.filtered or self.delay or self.detrend or self.decimate > 1)


AS_IT_IS = Preparation()
"""Nothing is done."""


@dataclass(frozen=True)
class Prepared:
    """A record as prepared; start: where in the original it begins [s]; steps: what was done."""

    dataset: Dataset
    start: float
    steps: tuple[str, ...]


def prepare(model: ProcessModel, record: Dataset, preparation: Preparation) -> Prepared:
    """A record with each channel unfiltered, in time, without trend, at the rate that is wanted.

    Names that are none of the model's channels are passed over. Raises PreparationError for a
    record that is too short.

    >>> from sysid.examples import lag, lag_record
    >>> record = lag_record()
    >>> made = prepare(lag(), record, Preparation(decimate=4))
    >>> record.n_samples, record.dt, made.dataset.n_samples, made.dataset.dt
    (200, 0.01, 35, 0.04)
    """
    made = Prepared(record, 0.0, ())
    for step in (_unfiltered, _in_time, _detrended, _decimated):
        made = step(model, made, preparation)
    return made


def _unfiltered(model: ProcessModel, before: Prepared, preparation: Preparation) -> Prepared:
    """Channels as they were before a filter of first order, as drives and meters compute it.

    Of y_k = a y_(k-1) + (1 - a) x_k with a = exp(-dt / tau), x. Noise that went through the filter
    is white again, and larger.
    """
    record = before.dataset
    names = (*model.input_names, *model.output_names)
    given = {name: tau for name, tau in preparation.filtered.items() if name in names}
    if not given:
        return before
    whole = record.n_samples * record.dt
    for name, tau in given.items():
        if tau > _LONGEST * whole:
            problem = f"{tau:g} s is more than a tenth of {record.name}, {whole:.3g} s"
            raise PreparationError(("filtered", name), problem)
    made = unfiltered(record, [given.get(name, 0.0) for name in names])
    words = [f"{name} {1e3 * tau:.4g} ms" for name, tau in given.items()]
    return replace(before, dataset=made, steps=(*before.steps, f"unfiltered: {', '.join(words)}"))


def unfiltered(record: Dataset, times: Sequence[float]) -> Dataset:
    """A record without filters of first order; times: of each input, then output, 0 for none.

    >>> record = Dataset(np.zeros(3), np.array([0.0, 0.5, 0.75]), 1.0)
    >>> unfiltered(record, [0.0, 1.0 / np.log(2.0)]).outputs[:, 0].round(9).tolist()
    [0.0, 1.0, 1.0]
    """
    poles = np.array([exp(-record.dt / time) if time > 0.0 else 0.0 for time in times])
    channels = np.column_stack((record.inputs, record.outputs))
    for k in np.flatnonzero(poles):  # a sample that was not measured is lost in these alone
        channels[1:, k] = (channels[1:, k] - poles[k] * channels[:-1, k]) / (1.0 - poles[k])
    noise = np.append(record.input_noise, record.output_noise)
    noise = noise * np.sqrt((1.0 + poles) / (1.0 - poles))
    n = record.inputs.shape[1]
    return replace(
        record,
        inputs=channels[:, :n],
        outputs=channels[:, n:],
        input_noise=noise[:n],
        output_noise=noise[n:],
    )


def _in_time(model: ProcessModel, before: Prepared, preparation: Preparation) -> Prepared:
    """Every channel moved by its delay; the rows that all channels have."""
    record = before.dataset
    names = (*model.input_names, *model.output_names)
    shifts = np.array([preparation.delay.get(name, 0.0) for name in names]) / record.dt
    whole = np.abs(shifts - np.round(shifts)) < _WHOLE
    shifts = np.where(whole, np.round(shifts), shifts)
    if not shifts.any():
        return before
    first = ceil(max(0.0, -shifts.min()))
    last = record.n_samples - 1 - ceil(max(0.0, shifts.max()))
    if last - first < 1:
        name = names[int(np.argmax(np.abs(shifts)))]
        problem = f"{record.name} is {record.n_samples * record.dt:g} s long"
        raise PreparationError(("delay", name), f"{problem}; the delay must be far shorter")
    rows, n = np.arange(first, last + 1), len(model.inputs)
    # A held input is what it is on the mean until the next sample, and changes on the way there.
    held = [signal.hold == "zoh" for signal in model.inputs] + [False] * len(model.outputs)
    channels = np.column_stack((record.inputs, record.outputs)).T
    moved = np.column_stack(
        [at_places(values, rows + shifts[k], held[k]) for k, values in enumerate(channels)]
    )
    windows, jitter, colour = record.windows, record.jitter, record.jitter_colour
    if windows.size:
        places = np.round(rows[:, None] + shifts[n:]).astype(np.int64)
        windows = np.take_along_axis(windows, places[..., None], axis=0)
        jitter = np.take_along_axis(jitter, places, axis=0)
        colour = np.take_along_axis(colour, places, axis=0)
    changes, last_part = _changes(record.inputs, rows, np.where(held[:n], shifts[:n], 0.0))
    made = replace(
        record,
        inputs=moved[:, :n],
        outputs=moved[:, n:],
        windows=windows,
        jitter=jitter,
        jitter_colour=colour,
        changes=changes,
        last_part=last_part,
    )
    given = {name: late for name, late in preparation.delay.items() if name in names and late}
    words = [
        f"{name} {1e3 * abs(late):.4g} ms {'earlier' if late > 0.0 else 'later'}"
        for name, late in given.items()
    ]
    steps = (*before.steps, f"moved: {', '.join(words)}")
    return Prepared(made, before.start + first * record.dt, steps)


def _changes(
    inputs: FloatArray, rows: IntArray, shifts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What held inputs (n, n_inputs) do between rows, so many samples later, as of ``Dataset``."""
    whole = np.floor(shifts)
    part = shifts - whole
    if not part.any():
        return np.zeros(0), np.zeros(0)
    first = rows[:, None] + whole.astype(np.int64)
    before, later = (
        np.take_along_axis(inputs, np.clip(at, 0, len(inputs) - 1), axis=0)
        for at in (first, first + 1)
    )
    return later - before, part


def acting_later(record: Dataset, places: Sequence[int], time: float) -> Dataset:
    """A record whose held inputs at some places act so much later [s] than it says.

    Before its first sample, and after its last, as at that.

    >>> record = Dataset(np.array([0.0, 1.0, 3.0]), np.zeros(3), 0.1)
    >>> acting_later(record, [0], 0.05).inputs[:, 0].tolist()
    [0.0, 0.5, 2.0]
    """
    rows, shifts = np.arange(record.n_samples), np.zeros(record.inputs.shape[1])
    shifts[list(places)] = -time / record.dt
    inputs = record.inputs.copy()
    for i in places:
        at = np.clip(rows + shifts[i], 0.0, record.n_samples - 1.0)
        inputs[:, i] = at_places(record.inputs[:, i], at, held=True)
    changes, last_part = _changes(record.inputs, rows, shifts)
    return replace(record, inputs=inputs, changes=changes, last_part=last_part)


def at_places(values: FloatArray, places: FloatArray, held: bool) -> FloatArray:
    """A channel at places that may lie between its samples; NaN beside a sample without a value."""
    below: IntArray = np.floor(places).astype(np.int64)
    above, between = np.ceil(places).astype(np.int64), places - below
    linear: FloatArray = values[below] + between * (values[above] - values[below])
    if held or not between.any():
        return linear
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) < 2:
        return linear
    from scipy.interpolate import CubicSpline  # half a second

    spline: FloatArray = CubicSpline(finite, values[finite])(places)
    return np.where(np.isfinite(linear), spline, np.nan)


def _detrended(model: ProcessModel, before: Prepared, preparation: Preparation) -> Prepared:
    """Channels without their mean or their straight line, which samples not measured leave out."""
    record, done = before.dataset, []
    tables = {"input": record.inputs.copy(), "output": record.outputs.copy()}
    zeros = {"input": record.input_zero.copy(), "output": record.output_zero.copy()}
    sides: dict[str, Sequence[Input | Output]] = {"input": model.inputs, "output": model.outputs}
    for side, signals in sides.items():
        for j, signal in enumerate(signals):
            kind = preparation.detrend.get(signal.name)
            if kind is None:
                continue
            values = tables[side][:, j]
            measured = np.flatnonzero(np.isfinite(values))
            powers = np.vander(record.time, 2 if kind == "linear" else 1)
            trend = powers @ np.linalg.lstsq(powers[measured], values[measured], rcond=None)[0]
            values -= trend
            zeros[side][j] = 0.0
            mean = f"{signal.name}, mean {trend.mean():.4g} {signal.unit}".rstrip()
            drift = f", drift {trend[-1] - trend[0]:.3g} {signal.unit}".rstrip()
            done.append(mean + drift * (kind == "linear"))
    if not done:
        return before
    record = replace(
        record,
        inputs=tables["input"],
        outputs=tables["output"],
        input_zero=zeros["input"],
        output_zero=zeros["output"],
    )
    return replace(before, dataset=record, steps=(*before.steps, f"taken off: {'; '.join(done)}"))


def low_pass(factor: float) -> FloatArray:
    """Taps of the filter before one of ``factor`` samples is left; odd in number, their sum 1.

    By Kaiser's window (Kaiser, 1974): what folds back lies above three quarters of the new
    Nyquist frequency, or 60 dB down.

    >>> taps = low_pass(10)
    >>> len(taps) % 2, round(float(taps.sum()), 12)
    (1, 1.0)
    """
    from scipy.signal import firwin, kaiserord  # half a second

    width = 2.0 * (1.0 - _PASSED) / factor
    length, beta = kaiserord(_STOPPED, width)
    taps: FloatArray = firwin(length | 1, 1.0 / factor, window=("kaiser", beta))
    return taps


def filtered(values: FloatArray, taps: FloatArray) -> FloatArray:
    """Channels (n, k) behind a filter, (n - len(taps) + 1, k); what was not measured has no weight.

    NaN where too little of what the filter sees was measured.
    """
    from scipy.signal import oaconvolve

    is_known = np.isfinite(values)
    shape = taps[:, None]
    sums: FloatArray = oaconvolve(np.where(is_known, values, 0.0), shape, mode="valid", axes=0)
    if is_known.all():
        return sums
    weights = oaconvolve(is_known.astype(np.float64), shape, mode="valid", axes=0)
    enough = weights > _KNOWN
    return np.where(enough, sums / np.where(enough, weights, 1.0), np.nan)


def _decimated(model: ProcessModel, before: Prepared, preparation: Preparation) -> Prepared:
    """One of several samples of each channel, behind a low-pass.

    Filtering inputs and outputs alike changes nothing of a linear process between them. A held
    input becomes its mean until the next sample that is left; sampled there it would come late by
    half of that time.
    """
    factor, record = preparation.decimate, before.dataset
    if factor <= 1:
        return before
    taps = low_pass(factor)
    half = len(taps) // 2
    if record.n_samples < 2 * half + factor + 1:
        problem = f"{record.name} has {record.n_samples} samples; {factor} needs at least"
        raise PreparationError(("decimate",), f"{problem} {2 * half + factor + 1}")
    inputs, outputs = filtered(record.inputs, taps), filtered(record.outputs, taps)
    mean = np.ones(factor) / factor
    held = np.array([signal.hold == "zoh" for signal in model.inputs], dtype=bool)
    ahead = np.concatenate((inputs, np.repeat(inputs[-1:], factor - 1, axis=0)))
    averaged = filtered(ahead, mean)
    inputs = np.where(held, averaged, inputs)
    kept = slice(half, record.n_samples - half, factor)
    # White noise by what the filters leave of it.
    rest = float(np.linalg.norm(taps))
    rest_of_held = float(np.linalg.norm(np.convolve(taps, mean)))
    made = replace(
        record,
        inputs=inputs[::factor],
        outputs=outputs[::factor],
        dt=factor * record.dt,
        windows=record.windows[kept],
        jitter=record.jitter[kept] * rest,
        jitter_colour=np.zeros(0),
        input_noise=record.input_noise * np.where(held, rest_of_held, rest),
        output_noise=record.output_noise * rest,
        changes=np.zeros(0),
    )
    step = (
        f"low-pass of {len(taps)} taps, and one of {factor} samples: {record.n_samples} of "
        f"{1e3 * record.dt:.4g} ms become {made.n_samples} of {1e3 * made.dt:.4g} ms"
    )
    return Prepared(made, before.start + half * record.dt, (*before.steps, step))
