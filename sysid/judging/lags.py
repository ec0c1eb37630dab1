"""Lags between channels, told before any fit: an output that comes late, an input that does.

Every output is regressed on what it was before, and on all inputs from long before to
long after (an ARX model that may foresee). Of a sampled plant the first input that counts is that
of the same sample or the one before, and it counts at once: numerators of plants sampled with a
hold begin 1; 1, 1; 1, 4, 1; 1, 11, 11, 1; 1, 26, 66 by how often they integrate (Astrom, Hagander &
Sternby, "Zeros of sampled systems", Automatica 20, 1984). Where clearly nothing stands before a
later sample, and there at once much, a channel lags; little that is clearly there is a beginning.
What is not clear is no lag: inputs that move together, or that a controller makes of outputs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset, of_one_rate
from sysid.problem.faults import DataFault, Part
from sysid.problem.model import ProcessModel
from sysid.threads import one_thread

_REACH = 14  # samples that an input is looked at before and after
_PAST = 4  # samples of the outputs' past
_MOST_ROWS = 20_000
_ROWS_EACH = 4  # rows for each coefficient
_SINGULAR = 1e-7  # of the largest singular value, below which columns say the same
_SURE = 8.0  # deviations at which a coefficient stands clear
_AT_ONCE = 6.0  # how many times what stands before it, two deviations of that included
# Deviations from which the one before it is there, and how many times that an input which begins so
# may grow in a sample.
_THERE, _BEGINNING = 2.5, 40.0
_HELD = 0.5  # share of samples that repeat the one before, from where no controller makes an input


@dataclass(frozen=True)
class Lag:
    """An output that begins to follow an input so many samples later than it could.

    Below zero it follows what the log shows only so many samples later.
    """

    output: int
    input: int
    samples: int


@one_thread()
def lags(records: Sequence[Dataset]) -> tuple[Lag, ...]:
    """Lags between inputs and outputs that are clear, of records with one sample time.

    >>> rng = np.random.default_rng(0)
    >>> u, y = np.repeat(rng.normal(size=200), 5), np.zeros(1000)
    >>> for k in range(999):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> lags([Dataset(u, y, 0.01)])
    ()
    >>> noise = 0.01 * rng.normal(size=1000)
    >>> lags([Dataset(u, np.roll(y, 3) + noise, 0.01)])
    (Lag(output=0, input=0, samples=3),)
    """
    pieces = [piece for record in records if (piece := _rows(record)) is not None]
    if not pieces:
        return ()
    pasts, around, now = (np.concatenate(parts)[:_MOST_ROWS] for parts in zip(*pieces, strict=True))
    held = [all(_held(record.inputs[:, i]) for record in records) for i in range(around.shape[2])]
    late = []
    for j in range(now.shape[1]):
        for i, onset in _onsets(pasts[:, :, j], around, now[:, j]).items():
            if onset > 1 or (onset < 0 and held[i]):
                late.append(Lag(j, i, onset - 1))
    return tuple(late)


def _onsets(past: FloatArray, around: FloatArray, now: FloatArray) -> dict[int, int]:
    """By input, how many samples before an output (n,) the first one stands that counts.

    past: (n, k), of the output; around: (n, width, n_inputs). Unclear ones are left out.
    """
    n, width, m = around.shape
    whole = np.isfinite(past).all(axis=1) & np.isfinite(now)
    columns = np.concatenate([past, around.reshape(n, width * m), np.ones((n, 1))], axis=1)[whole]
    varied = np.ptp(columns, axis=0) > 0.0 if len(columns) else np.zeros(columns.shape[1], bool)
    varied[-1] = True
    freedom = len(columns) - int(varied.sum())
    if len(columns) < _ROWS_EACH * varied.sum():
        return {}
    used = columns[:, varied]
    scale = np.sqrt(np.mean(used**2, axis=0))
    left, values, right = np.linalg.svd(used / scale, full_matrices=False)
    if values[-1] < _SINGULAR * values[0]:
        return {}  # inputs that move together: which of them acts, and when, is not told
    inverse = right.T / values
    target = now[whole]
    coefficients = inverse @ (left.T @ target)
    rest = target - (used / scale) @ coefficients
    deviations = np.linalg.norm(inverse, axis=1) * np.sqrt(np.sum(rest**2) / freedom)
    order, onsets = np.cumsum(varied) - 1, {}
    for i in range(m):
        places = past.shape[1] + i + m * np.arange(width)
        if varied[places].all():
            at = order[places]
            onset = _onset(coefficients[at], deviations[at])
            if onset is not None:
                onsets[i] = onset
    return onsets


def lag_faults(
    model: ProcessModel, records: Sequence[Dataset], part: Part = "training"
) -> tuple[DataFault, ...]:
    """Faults of records by lags between their channels."""
    if not of_one_rate(records):
        return ()
    return tuple(_faults(model, records, lags(records), part))


def _faults(
    model: ProcessModel, records: Sequence[Dataset], clear: Sequence[Lag], part: Part
) -> Iterator[DataFault]:
    """The largest lag of each output that is late, and of each input that is."""
    worst: dict[str, Lag] = {}
    for lag in sorted(clear, key=lambda lag: abs(lag.samples)):
        late = lag.samples > 0
        worst[model.output_names[lag.output] if late else model.input_names[lag.input]] = lag
    for channel, lag in worst.items():
        driver, follower = model.input_names[lag.input], model.output_names[lag.output]
        count = abs(lag.samples)
        time = f"{count} sample{'s' * (count != 1)} ({count * records[0].dt:.3g} s)"
        says = (
            f"{follower} follows {driver} {time} later than a sampled plant does"
            if lag.samples > 0
            else f"{follower} moves {time} before {driver} as logged does: {driver} comes later"
        )
        yield DataFault(
            kind="lag",
            severity="doubt",
            part=part,
            records=tuple(record.name for record in records),
            channel=channel,
            statement=says,
            effect="the fit makes inertias and time constants of what a channel lags",
            cure=f"log {channel} with the others, or take its lag out: "
            f"'delay: {{{channel}: {count * records[0].dt:.3g} s}}'; a plant with a dead time "
            "needs one in its inputs",
            share=1.0,
            moves_parameters=part == "training",
            settings=(f"delay.{channel}={count * records[0].dt:.3g}",),
        )


def _rows(record: Dataset) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Outputs' past (n, k, q), inputs (n, width, m), those after the sample first, outputs (n, q).

    None of a record that is too short.
    """
    first = max(_REACH, _PAST)
    last = min(record.n_samples - _REACH, first + _MOST_ROWS)
    if last - first < 2:
        return None
    rows, outputs = np.arange(first, last), record.outputs
    if record.windows.size:  # means over the past come late, and the model knows
        outputs = np.where(record.windows.any(axis=(0, 2)), np.nan, outputs)
    past = np.stack([outputs[rows - k] for k in range(1, _PAST + 1)], axis=1)
    around = np.stack([record.inputs[rows - k] for k in range(-_REACH, _REACH + 1)], axis=1)
    return past, around, outputs[rows]


def _onset(coefficients: FloatArray, deviations: FloatArray) -> int | None:
    """How many samples before an output the first input stands that counts; None if not clear."""
    clear = np.flatnonzero(np.abs(coefficients) > _SURE * deviations)
    if not len(clear):
        return None
    first = int(clear[0])
    before = np.abs(coefficients[:first]) + 2.0 * deviations[:first]
    if first == 0 or np.any(_AT_ONCE * before > abs(coefficients[first])):
        return None
    little = abs(coefficients[first - 1])
    begins = little > _THERE * deviations[first - 1]
    if begins and abs(coefficients[first]) < _BEGINNING * little:
        return None
    return first - _REACH


def _held(values: FloatArray) -> bool:
    """Whether an input stands at levels, as no controller that hears noise makes it."""
    return float(np.mean(np.diff(values) == 0.0)) > _HELD
