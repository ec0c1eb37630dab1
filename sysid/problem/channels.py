"""What is wrong with the samples of one channel, read from the samples alone.

Each test takes the samples of a channel in time, (n,), NaN where one was lost, and returns what it
finds, or None. Steps, pulses, levels held, rest, quantisation and noise as sensors have them are
not faults, and what looks like one without being sure to be it is left alone.
"""

from dataclasses import dataclass

import numpy as np

from sysid.arrays import BoolArray, FloatArray

_EQUAL = 1e-9  # of a channel's span: samples so close are the same
_RESTING = 1e-3  # of its span: how near 0 a level is that of rest
_FEWEST, _FEWEST_ALONE = 8, 3  # samples cut off; where values of a channel never come again
_HARMLESS = 1e-4  # of a channel's variance
_NEARBY = 8  # samples on either side, among which one stands out
_SOME, _BRIEF = 4, 32  # samples of a burst
# Share of samples that repeat the one before, below which noise of 0.4 steps and more, or motion,
# carries a channel across its steps: what rounding adds is a hundredth of a step in the mean then.
_HELD = 0.6
_SHORT, _LONGER = 1.0, 2.0  # samples, and times a mean's own, of means that foretell it
MEDIAN_OF_NORMAL = 0.6745  # median of the absolute value of a standard normal variable


@dataclass(frozen=True)
class PileUp:
    """Samples that stand at a channel's largest or smallest value.

    level: that value. share: of all samples. stretches: how often the channel gets there.
    at: (n,), which samples.
    """

    level: float
    share: float
    stretches: int
    at: BoolArray


@dataclass(frozen=True)
class Spikes:
    """Single samples far off their neighbours.

    share: of all samples. size: of the median one. at: (n,), which samples.
    """

    share: float
    size: float
    at: BoolArray


@dataclass(frozen=True)
class Standstill:
    """A stretch in which a channel with noise repeats one value.

    value: it. first, length: of the longest such stretch, in samples. at: (n,), samples of all.
    """

    value: float
    first: int
    length: int
    at: BoolArray


@dataclass(frozen=True)
class Steps:
    """Resolution of a channel that is coarser than its noise: the step, and steps in its span."""

    step: float
    levels: int


def pile_ups(values: FloatArray) -> list[PileUp]:
    """Where a channel was cut off: at its largest value, at its smallest, or at both.

    The channel runs into the value and leaves it at full slope, time and again, and is there far
    more often than at values just short of it. Levels held on purpose, turning points and a rest
    at 0 are no such thing.

    >>> wave = np.sin(0.1 * np.arange(500))
    >>> [round(pile.level, 2) for pile in pile_ups(np.minimum(wave, 0.8))], pile_ups(wave)
    ([0.8], [])
    """
    piles = (_pile_up(values), _pile_up(-values))
    signed = zip(piles, (1.0, -1.0), strict=True)
    return [PileUp(s * p.level, p.share, p.stretches, p.at) for p, s in signed if p is not None]


def _pile_up(values: FloatArray) -> PileUp | None:
    """Of samples at the largest value."""
    measured = np.flatnonzero(np.isfinite(values))
    v = values[measured]
    span = float(np.ptp(v)) if len(v) else 0.0
    if span == 0.0:
        return None
    top = float(v.max())
    at = v >= top - _EQUAL * span
    count = int(at.sum())
    levels, counts = np.unique(v[~at], return_counts=True)
    if len(levels) < 20 or abs(top) < _RESTING * span:
        return None
    # Where no value between the ends ever comes again, chance does not make three of the largest.
    between = v[~at & (v > float(v.min()) + _EQUAL * span)]
    alone = len(np.unique(between)) == len(between)
    often = max(_FEWEST, 0.002 * len(v), _FEWEST * float(counts[-5:].mean()))
    if count < (_FEWEST_ALONE if alone else often):
        return None
    edges = np.flatnonzero(np.diff(at.astype(np.int8)))
    stretches = (len(edges) + int(at[0]) + int(at[-1])) // 2
    # How far the channel was from the level a sample before it got there, and after it left.
    steps = v[edges + 1] - v[edges]
    entries, exits = steps[steps > 0.0], -steps[steps < 0.0]
    moving = np.abs(np.diff(v[~at]))
    moving = moving[moving > _EQUAL * span]
    if stretches < 2 or not len(moving) or _is_piecewise_linear(v):
        return None
    slowest = min(np.median(entries), np.median(exits))
    if slowest < max(2.0 * np.diff(levels).min(), 0.03 * float(np.median(moving))):
        return None
    place = np.zeros(len(values), dtype=np.bool_)
    place[measured[at]] = True
    return PileUp(top, count / len(v), stretches, place)


def _is_piecewise_linear(v: FloatArray) -> bool:
    """Whether a channel is made of ramps and levels, as people design them."""
    slopes = np.diff(v)
    bends = np.abs(np.diff(slopes))
    sloping = np.abs(slopes[1:]) > _EQUAL * np.ptp(v)
    return bool(sloping.any()) and float(np.median(bends[sloping])) < 1e-3 * float(
        np.median(np.abs(slopes[1:][sloping]))
    )


def noise(values: FloatArray) -> float:
    """Standard deviation of a channel's white noise, from its third differences.

    0 where they are what a smooth signal without noise has.

    >>> print(round(noise(np.random.default_rng(0).normal(0.0, 0.1, 4000)), 2))
    0.1
    >>> noise(np.sin(0.1 * np.arange(500)))
    0.0
    """
    v = values[np.isfinite(values)]
    if len(v) < 8:
        return 0.0
    first, third = (
        float(np.median(np.abs(np.diff(v, order)))) / MEDIAN_OF_NORMAL / width
        for order, width in ((1, np.sqrt(2.0)), (3, np.sqrt(20.0)))
    )
    return float(third) if third > 0.3 * first else 0.0


def resolution(values: FloatArray) -> float:
    """The least difference between two of a channel's values: its resolution; 0 of none."""
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > _EQUAL * np.ptp(levels)] if len(levels) > 1 else gaps
    return float(gaps.min()) if len(gaps) else 0.0


def off_neighbours(values: FloatArray) -> FloatArray:
    """How far each sample is from the mean of its neighbours, (n, ...), zero at both ends."""
    off = np.zeros_like(values)
    off[1:-1] = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    return off


def spikes(values: FloatArray, inputs: FloatArray, averaged: FloatArray) -> Spikes | None:
    """Single samples that leave their neighbours and return, too far for noise, or a sharp corner.

    And short bursts of such, to and fro, beyond all that the channel does elsewhere. None where all
    together they are below a per cent of the channel's own deviation.
    inputs: (n, n_inputs), whose jumps answer for pulses that follow them. averaged: (n,), samples
    over which each is a mean: one of many tells nothing of what a shorter one beside it may be.

    >>> quiet = 0.01 * np.random.default_rng(0).standard_normal(400)
    >>> jolted = quiet + np.isin(np.arange(400), [30, 90, 300])
    >>> spikes(jolted, np.zeros((400, 1)), np.zeros(400)).at.nonzero()[0].tolist()
    [30, 90, 300]
    """
    n = len(values)
    before, middle, after = values[:-2], values[1:-1], values[2:]
    away = off_neighbours(values)[1:-1]
    returned = np.abs(after - before) < 0.3 * np.minimum(
        np.abs(middle - before), np.abs(middle - after)
    )
    # Or so far beyond two neighbours on either side as these are apart, as where a step is.
    around = np.stack([np.roll(values, k)[1:-1] for k in (-2, -1, 1, 2)])
    low, high = around.min(axis=0), around.max(axis=0)
    beyond = np.maximum(middle - high, low - middle)
    returned |= beyond > 0.9 * (high - low)
    # A response that rings turns as sharply, but on a curve that its neighbours foretell.
    far_before, near_before, near_after, far_after = around
    curve = (4.0 * (near_before + near_after) - far_before - far_after) / 6.0
    returned[1:-1] &= (np.abs(middle - curve) > 0.5 * np.abs(away))[1:-1]
    finite = away[np.isfinite(away)]
    if len(finite) < 20:
        return None
    rough = float(np.median(np.abs(finite)))
    # Among others as large, as where an excitation turns every few samples, none stands alone.
    sizes = np.pad(np.where(np.isfinite(away), np.abs(away), rough), _NEARBY, "edge")
    nearby = np.median(np.lib.stride_tricks.sliding_window_view(sizes, 2 * _NEARBY + 1), axis=1)
    usual = np.maximum(np.maximum(rough, nearby) / MEDIAN_OF_NORMAL, resolution(values))
    at = np.zeros(n, dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        at[1:-1] = returned & (np.abs(away) > 7.0 * usual) & (usual > 0.0)
    # A shaft that slips out of its rest for a sample.
    at[1:-1] &= (before != 0.0) | (after != 0.0)
    around_it = np.maximum(averaged[:-2], averaged[2:])
    at[1:-1] &= around_it <= np.maximum(_SHORT, _LONGER * averaged[1:-1])
    jolted = _after(_jumps(inputs))
    for after_jump in jolted.T:
        reactions = np.abs(away)[after_jump[1:-1] & np.isfinite(away)]
        if len(reactions):
            # What follows an input's jump may be as large as what usually follows one of it.
            reaction = np.quantile(reactions, 0.9)
            at[1:-1] &= ~after_jump[1:-1] | (np.abs(away) > 3.0 * reaction)
    noise_at_most = 7.0 * max(rough / MEDIAN_OF_NORMAL, resolution(values))
    by_any: BoolArray = np.any(jolted, axis=1)
    at |= _bursts(values, away, noise_at_most, by_any)
    count = int(at.sum())
    if count == 0:
        return None
    sizes = np.abs(away[at[1:-1]])
    if sizes @ sizes < _HARMLESS * len(finite) * np.nanvar(values):
        return None
    return Spikes(count / len(finite), float(np.median(sizes)), at)


def _bursts(values: FloatArray, away: FloatArray, least: float, jolted: BoolArray) -> BoolArray:
    """Samples of short bursts that go to and fro beyond a channel's range elsewhere, (n,).

    away: of samples from their neighbours' mean, (n - 2,). least: of it that is no noise. jolted:
    where an input has just jumped, (n,), which what follows may answer.
    """
    at = np.zeros(len(values), dtype=np.bool_)
    wild = 1 + np.flatnonzero(np.abs(away) > least)
    for group in np.split(wild, 1 + np.flatnonzero(np.diff(wild) > _NEARBY // 2)):
        if not _SOME <= len(group) <= _BRIEF or least == 0.0:
            continue
        inside = slice(max(group[0] - 1, 0), group[-1] + 2)
        rest = np.delete(values, inside)
        low, high = np.nanmin(rest), np.nanmax(rest)
        beyond = max(np.nanmax(values[inside]) - high, low - np.nanmin(values[inside]))
        turns = np.mean(np.diff(np.sign(away[group[0] - 1 : group[-1]])) != 0.0)
        answers = jolted[max(group[0] - _NEARBY, 0) : group[-1] + 1].any()
        if beyond > 0.25 * (high - low) and turns > 0.5 and not answers:
            at[group] = True
    return at


def _after(jumps: BoolArray) -> BoolArray:
    """Samples of jumps (n, n_inputs), and the three that follow each."""
    after = jumps.copy()
    for late in (1, 2, 3):
        after[late:] |= jumps[:-late]
    return after


def _jumps(inputs: FloatArray) -> BoolArray:
    """Samples at which each input jumps, (n, n_inputs)."""
    jumps = np.zeros(inputs.shape, dtype=np.bool_)
    for i, column in enumerate(inputs.T):
        steps = np.abs(np.diff(column))
        largest = max(float(steps.max(initial=0.0)), float(np.abs(column[0])))
        jumps[1:, i] = (steps > 0.01 * largest) & (steps > 10.0 * np.median(steps))
        # A record that begins under an input begins with its jump.
        jumps[0, i] = abs(column[0]) > 0.01 * largest > 0.0
    return jumps


def standstill(values: FloatArray, inputs: FloatArray, averaged: FloatArray) -> Standstill | None:
    """Where a channel that is never twice the same repeats a value for long, then jumps.

    A channel that comes to rest slows down before, and one that has been at rest has not moved.
    inputs: (n, n_inputs), whose jumps end a rest. averaged: (n,), samples over which each is a
    mean, which is the same in all of them.

    >>> trace = np.arange(400) + 0.5 * np.random.default_rng(0).standard_normal(400)
    >>> trace[100:150] = trace[100]
    >>> hang = standstill(trace, np.zeros((400, 1)), np.zeros(400))
    >>> hang.first, hang.length
    (100, 50)
    """
    steps = np.abs(np.diff(values, prepend=values[:1], append=values[-1:]))
    same = steps[1:-1] == 0.0
    if not same.any():
        return None
    usual = float(np.nanmedian(steps))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    begins, lengths = edges[::2], edges[1::2] - edges[::2] + 1
    # It is caught in motion, at 0 where it might rest in fast motion, and jumps when it is free.
    resting = np.abs(values[begins]) < _RESTING * float(np.nanmax(np.abs(values)))
    least = np.where(resting, 5.0 * usual, max(0.01 * usual, 1.5 * resolution(values)))
    caught = (steps[begins] > least) & (steps[begins + lengths] > 5.0 * usual)
    # What has settled moves with the next jump of an input, and has not slept through another.
    jumps = np.concatenate([[0], np.cumsum(_jumps(inputs).any(axis=1)), [0, 0, 0]])
    ends = begins + lengths
    slept = jumps[ends - 3] > jumps[begins + 4]
    caught &= slept | (jumps[np.minimum(ends + 1, len(values))] == jumps[ends - 3])
    caught &= averaged[begins] < lengths - 2
    hangs = (lengths >= 20) & caught & (usual > 0.0)
    repeated = (int(same.sum()) - int((lengths[hangs] - 1).sum())) / len(values)
    if not hangs.any() or repeated > 0.1:
        return None
    at = np.zeros(len(values), dtype=np.bool_)
    for begin, length in zip(begins[hangs], lengths[hangs], strict=True):
        at[begin : begin + length] = True
    place = int(np.argmax(np.where(hangs, lengths, 0)))
    first = int(begins[place])
    return Standstill(float(values[first]), first, int(lengths[place]), at)


def coarse_steps(values: FloatArray) -> Steps | None:
    """The resolution of a measured channel that mostly repeats its last value.

    Only where it moves over fewer than 64 steps, all alike: finer ones do no harm. Nor do steps
    that noise moves the channel across at nearly every other sample: rounding averages out then.

    >>> coarse_steps(np.round(8.0 * np.sin(0.02 * np.arange(1000)))).levels
    17
    >>> noise = 0.5 * np.random.default_rng(0).standard_normal(1000)
    >>> coarse_steps(np.round(8.0 * np.sin(0.02 * np.arange(1000)) + noise))
    """
    v = values[np.isfinite(values)]
    levels = np.unique(v)
    if not 4 <= len(levels) < 64:
        return None
    step = float(np.diff(levels).min())
    counts = np.abs(np.diff(v)) / step
    jumps = counts[counts > 0.5]
    even = np.abs(np.diff(levels) / step - np.round(np.diff(levels) / step)).max() < 0.05
    held = 1.0 - len(jumps) / max(len(counts), 1)
    if not even or held < _HELD or len(v) < 3 * len(levels):
        return None
    return Steps(step, len(levels))
