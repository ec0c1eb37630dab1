"""What a model may lack, each as the change of the outputs that a little of it would make.

Faults of the channels: delay, offset, drift, gain, saturation. What the model's own variants have
and it has not, in their terms. And functions of every state and input in every equation, which
need no idea of what is missing.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.engine.linear_response import observed
from sysid.judging.disturbed import DisturbedRun, Rates, delayed, of_each, rates_of_each, shifted
from sysid.judging.input_noise import likely_noise, standing_out
from sysid.linear.polynomials import all_pole
from sysid.problem.channels import noise
from sysid.problem.data import Dataset
from sysid.problem.model import Input, ProcessModel, State
from sysid.problem.terms import AddedTerm, Shape, rate_unit
from sysid.uncertainty.colour import record_rows

Kind = Literal[
    "variant",
    "delay",
    "mean",
    "filter",
    "lag",
    "play",
    "offset",
    "drift",
    "gain",
    "saturation",
    "crosstalk",
    "noise",
    "change",
    "follower",
    "resonance",
    "bend",
    "function",
    "curve",
    "disturbance",
    "rest",
    "fixed",
    "exchange",
    "feedback",
]

SPEEDS = ("rad/s", "deg/s", "m/s", "cm/s", "mm/s")  # units of what turns or slides

_PARTS = (0.5, 2.0)  # of a variant's further parameters
_KNEE = 0.8  # share of a signal's peak from where its saturation is looked for
_LEVELS = 3  # of a signal, below which it shows no function
# Mean square of a signal's steps in parts of its variance, from where it jumps: of what was
# measured, and of a state, which the run follows between samples too, one of six samples a period.
_JUMPING, _JUMPING_STATE = 0.05, 1.0
# Delays that are tested [samples]: of a large one a small one tells little where inputs jump.
_DELAYS = (0.1, -0.1, -12.0, -4.0, 4.0, 12.0)
_CROSSTALK = 0.1  # part of an output that is at most what its sensor sees of something else
_FILTERS = (1.0, 5.0)  # time constants of filters that are tested [samples]
_PLAYS = (0.02, 0.1)  # parts of an input's peak
# Deviations of chance by which two levels differ; samples that a signal stands at a level at least,
# in the mean; and mean square of the slopes there in parts of chance.
_STEP, _STANDS, _RISING = 4.5, 5, 2.0
_RECORD = 0.1  # of a record, beyond which no delay is tested
PROBE = 1e-3  # part of a parameter that tells how rates follow it
_PERIODS = (1, 2, 3, 4)  # of a disturbance that nobody measured, in a record
# How a parameter may change with the size, up to 1, of what it multiplies: with it, with its
# square, and near its zero.
_BENDS: tuple[Callable[[FloatArray], FloatArray], ...] = (
    lambda z: z,
    lambda z: z**2,
    lambda z: 1.0 / (z + 0.05),
)
_BENT: tuple[Shape, ...] = ("abs", "parabola")  # the first of these, as a fit takes them
# Samples that an input stands at zero at least, and least share of records that it does or not.
_AT_REST, _OFTEN = 5, 0.05
_PROPORTIONAL = 1e-6  # what a term may be beside a signal that it is in proportion to
_POINTS = 50  # at which an equation is asked for what it depends on
# Stribeck speeds that are tried, in parts of the largest speed.
_STANDSTILL = (0.02, 0.04, 0.08, 0.16, 0.32)
_STICTION = 1e-3  # of a signal's largest value, below which a sign is not a jump
_ROUNDED = 0.03  # the same where it is tested: a wrong run passes zero a little early or late


@dataclass(frozen=True, eq=False)
class Suspect:
    """What may be missing: columns of changes per unit of its amplitudes.

    name: of the channel, the variant, or the equation. terms: of functions, one for each amplitude,
    their ranges those of one unit. changes: (n_rows, n_outputs, n_amplitudes), records one after
    another, in the outputs' units. late: of a delay or a filter, the change by so many seconds of
    it: where outputs jump that by a little is no guide. of_input: whether a channel is an input.
    mean: of an output that comes late, what it is as a mean over the time since the sample before.
    closer: the same of sizes beside its own, where those that are tested are far apart. most: size
    of an amplitude from which it is something else. size: of what no amplitude tells, in the unit.
    """

    kind: Kind
    name: str
    unit: str
    changes: FloatArray
    terms: tuple[AddedTerm, ...] = ()
    late: Callable[[float], FloatArray] | None = None
    of_input: bool = False
    mean: Callable[[], "Suspect"] | None = None
    closer: Callable[[], "Sequence[Suspect]"] | None = None
    most: float = math.inf
    size: float | None = None

    @property
    def one_sided(self) -> bool:
        """Whether only amplitudes above zero make sense: friction never drives."""
        rubs = any(term.shape == "stribeck" for term in self.terms)
        one_sided = "variant", "saturation", "filter", "lag", "play", "noise", "follower"
        return rubs or self.kind in one_sided

    @property
    def repeats(self) -> bool:
        """Whether it is a sine of a signal."""
        return any(term.shape == "sine" for term in self.terms)

    def shares_place(self, suspect: "Suspect") -> bool:
        """Whether it is a function of the same signal in the same equation, of whatever shape.

        Sines of other periods are no other shapes of one that repeats.
        """
        return self.acts_like(suspect) and not (self.repeats or suspect.repeats)

    def acts_like(self, suspect: "Suspect") -> bool:
        """Whether it is a function of the same signal in the same equation, a sine as well."""
        terms = (*self.terms, *suspect.terms)
        places = {(term.equation, term.of) for term in terms}
        return bool(self.terms) and bool(suspect.terms) and len(places) == 1

    def same(self, suspect: "Suspect") -> bool:
        """Whether it is of the same channel or state, and of another delay, period or time."""
        sized = self.late is not None or self.size is not None
        return sized and (self.kind, self.name) == (suspect.kind, suspect.name)


def channel_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Faults of the outputs' and inputs' channels, the same throughout all records.

    Offsets of channels whose zero was calibrated are left out: how wrong it may be is known.
    """
    model = runs[0].model
    for j, output in enumerate(model.outputs):
        mean = partial(_mean_output, runs, j)
        for kind, is_late in _LATE_OUTPUTS.items():
            for late in _late(kind, output.name, partial(is_late, runs, j), runs):
                yield replace(late, mean=mean)
        zeroed = any(run.record.output_zero[j] for run in runs)
        for kind, signal in _faults(partial(_output, j), zeroed):
            changes = _logged(runs, j, signal)[..., None]
            yield Suspect(kind, output.name, _unit(kind, output.unit), changes)
    yield from _crosstalk(runs)
    for i, given in enumerate(model.inputs):
        if not any(np.any(run.record.inputs[:, i]) for run in runs):
            continue
        ways = {kind: partial(_input_changed, runs, i, way) for kind, way in _LATE_INPUTS.items()}
        if given.hold == "zoh":
            ways["delay"] = partial(_acted_before, runs, i)
        for kind, change in ways.items():
            for late in _late(kind, given.name, change, runs):
                yield replace(late, of_input=True)
        yield from _plays(given, partial(_input_changed, runs, i, _with_play), runs, i)
        yield from _noises(given, runs, i)
        zeroed = any(run.record.input_zero[i] for run in runs)
        for kind, signal in _faults(partial(_input, i), zeroed):
            # By what a log has too much, less has acted.
            sign = -1.0 if kind in ("offset", "drift") else 1.0
            changes = sign * _driven(runs, i, signal)
            unit = _unit(kind, given.unit)
            yield Suspect(kind, given.name, unit, changes[..., None], of_input=True)


def _crosstalk(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Outputs whose sensors see an input without noise, or another output, as well."""
    model, exact = runs[0].model, runs[0].record.input_noise == 0.0
    channels = [
        (s.name, s.unit, partial(_input, i)) for i, s in enumerate(model.inputs) if exact[i]
    ]
    channels += [(s.name, s.unit, partial(_output, j)) for j, s in enumerate(model.outputs)]
    seen = [(*channel, _rms(runs, channel[2])) for channel in channels]
    sizes = {name: size for name, _, _, size in seen}
    for j, output in enumerate(model.outputs):
        for name, unit, signal, size in seen:
            if name == output.name or not size:
                continue
            changes = _logged(runs, j, signal)[..., None]
            place, by = f"{name} stands in {output.name}", f"{output.unit}/{unit}"
            most = _CROSSTALK * sizes[output.name] / size
            yield Suspect("crosstalk", place, by, changes, most=most)


def _rms(runs: Sequence[DisturbedRun], signal: Callable[[DisturbedRun], FloatArray]) -> float:
    """Root mean square of a signal (n_samples,) along all runs."""
    return float(np.sqrt(np.mean(np.concatenate([signal(run) for run in runs]) ** 2)))


def _late(
    kind: Kind, name: str, change: Callable[[float], FloatArray], runs: Sequence[DisturbedRun]
) -> Iterator[Suspect]:
    """A channel that comes late, or early, by little and by more."""
    shortest = min(run.record.n_samples for run in runs)
    for samples in _DELAYS if kind == "delay" else _FILTERS:
        if abs(samples) < _RECORD * shortest:
            time = samples * runs[0].record.dt
            yield Suspect(kind, name, "s", change(time) / time, late=change)


def _late_output(runs: Sequence[DisturbedRun], j: int, delay: float) -> FloatArray:
    return _logged(runs, j, lambda run: run.late(j, delay))[..., None]


def _filtered_output(runs: Sequence[DisturbedRun], j: int, time: float) -> FloatArray:
    def change(run: DisturbedRun) -> FloatArray:
        return run.averaged(j, smoothed(run.instants[:, j], time / run.record.dt))

    return _logged(runs, j, change)[..., None]


_LATE_OUTPUTS: dict[Kind, Callable[[Sequence[DisturbedRun], int, float], FloatArray]] = {
    "delay": _late_output,
    "filter": _filtered_output,
}


def _mean_output(runs: Sequence[DisturbedRun], j: int) -> Suspect:
    """An output that is its mean since the sample before, as the difference of two positions is."""
    changes = _logged(runs, j, lambda run: run.mean(j) / run.record.dt)
    return Suspect("mean", runs[0].model.outputs[j].name, "s", changes[..., None])


def _logged(
    runs: Sequence[DisturbedRun], j: int, signal: Callable[[DisturbedRun], FloatArray]
) -> FloatArray:
    """Changes by a signal (n_samples,) of each record beside what is logged of an output."""
    return of_each(runs, lambda run: run.logged(_column(run.outputs, j, signal(run))))


_Change = Callable[[DisturbedRun, int, float], FloatArray]


def _input_changed(
    runs: Sequence[DisturbedRun], i: int, change: _Change, size: float
) -> FloatArray:
    return _driven(runs, i, lambda run: change(run, i, size))[..., None]


def _driven(
    runs: Sequence[DisturbedRun], i: int, signal: Callable[[DisturbedRun], FloatArray]
) -> FloatArray:
    """Changes by a signal (n_samples,) of each record beside what is logged of an input."""
    return of_each(runs, lambda run: run.driven(_column(run.record.inputs, i, signal(run))))


def _plays(
    given: Input, change: Callable[[float], FloatArray], runs: Sequence[DisturbedRun], i: int
) -> Iterator[Suspect]:
    """An input that acts through play, by little and by more."""
    peak = max(float(np.abs(run.record.inputs[:, i]).max()) for run in runs)
    for part in _PLAYS:
        size = part * peak
        changes = change(size) / size
        yield Suspect("play", given.name, given.unit, changes, late=change, of_input=True)


def _noises(given: Input, runs: Sequence[DisturbedRun], i: int) -> Iterator[Suspect]:
    """White noise of an input of which none is known: what was logged and has not acted.

    By so much of it as the input's own samples show, of which a Wiener filter tells what it was;
    of an input that stands at levels what is beside them holds its slow part, too.
    """
    records = [run.record for run in runs]
    size = input_noise(records, i)
    if any(record.input_noise[i] for record in records) or not size:
        return
    changes = _driven(runs, i, lambda run: _shown_noise(run.record.inputs[:, i], size))
    changes = -changes[..., None] / size
    yield Suspect("noise", given.name, given.unit, changes, of_input=True)


def input_noise(records: Sequence[Dataset], i: int) -> float:
    """Standard deviation of an input's white noise as its samples show it; 0 of a smooth one."""
    sizes = [noise(record.inputs[:, i]) for record in records]
    return float(np.sqrt(np.mean(np.square(sizes))))


def _with_play(run: DisturbedRun, i: int, width: float) -> FloatArray:
    """What acts is dragged along by the ends of the play."""
    signal = run.record.inputs[:, i]
    at, dragged = float(signal[0]), []
    for value in signal.tolist():
        at = min(max(at, value - 0.5 * width), value + 0.5 * width)
        dragged.append(at)
    change: FloatArray = np.array(dragged) - signal
    return change


def _acted_before(runs: Sequence[DisturbedRun], i: int, time: float) -> FloatArray:
    """A held input that is logged late has acted before, within a sample as well."""
    return of_each(runs, lambda run: run.acted_before(i, _acting(run, i), time))[..., None]


def _moved_forward(run: DisturbedRun, i: int, time: float) -> FloatArray:
    return shifted(_acting(run, i), time / run.record.dt, held=False)


def _unfiltered(run: DisturbedRun, i: int, time: float) -> FloatArray:
    """What acted, of which a filter was logged, was steeper."""
    signal, pole = _acting(run, i), np.exp(-run.record.dt / time)
    change: FloatArray = np.diff(signal, prepend=signal[0]) * pole / (1.0 - pole)
    return change


def _lagging(run: DisturbedRun, i: int, time: float) -> FloatArray:
    return smoothed(_acting(run, i), time / run.record.dt)


def _acting(run: DisturbedRun, i: int) -> FloatArray:
    """What of an input (n_samples,) stands out of its noise, which has not acted.

    How the noise would be shifted seems to tell a delay far better than the signal does, and what
    it does by its second power, next to nothing, to be one.
    """
    signal, deviation = run.measured[:, i], float(run.record.input_noise[i])
    return standing_out(signal, deviation, float(run.colour[i])) if deviation else signal


_LATE_INPUTS: dict[Kind, _Change] = {
    "delay": _moved_forward,
    "filter": _unfiltered,
    "lag": _lagging,
}


def smoothed(signal: FloatArray, samples: float) -> FloatArray:
    """Change of a signal by a filter of first order with this time constant."""
    if not samples > 0.0:
        return np.zeros_like(signal)
    pole = np.exp(-1.0 / samples)
    moved = signal - signal[0]
    smoothed = all_pole(np.array([-pole]), (1.0 - pole) * moved[:, None])
    change: FloatArray = smoothed[:, 0] - moved
    return change


def in_single_records(
    suspects: Sequence[Suspect], runs: Sequence[DisturbedRun]
) -> Iterator[Suspect]:
    """Faults of channels as they would be in one of several records alone."""
    if len(runs) == 1:
        return
    for run, rows in zip(runs, rows_of(runs), strict=True):
        for suspect in suspects:
            changes = only(rows, suspect.changes)
            name = f"{suspect.name} of {run.record.name}"
            late = None if suspect.late is None else partial(_within, rows, suspect.late)
            yield replace(suspect, name=name, changes=changes, late=late, mean=None)


def _within(rows: slice, late: Callable[[float], FloatArray], delay: float) -> FloatArray:
    return only(rows, late(delay))


def rows_of(runs: Sequence[DisturbedRun]) -> list[slice]:
    """Where each record stands in the changes of all."""
    return record_rows([run.record.n_samples for run in runs])


def only(rows: slice, changes: FloatArray) -> FloatArray:
    """Changes at some rows, and none elsewhere."""
    part = np.zeros_like(changes)
    part[rows] = changes[rows]
    return part


def _shown_noise(signal: FloatArray, deviation: float) -> FloatArray:
    """What of a signal (n,) is likely to be the noise that its samples show."""
    beside = _beside_levels(signal, deviation)
    return likely_noise(signal, deviation) if beside is None else beside


def _beside_levels(signal: FloatArray, deviation: float) -> FloatArray | None:
    """A signal (n,) less the levels that it stands at; None where it stands at none.

    Stretches are cut where their two parts' means differ by more than noise of this deviation
    makes (Scott & Knott, "A cluster analysis method for grouping means", Biometrics 30, 1974). A
    signal that is smooth goes on rising within them.
    """
    beside, slopes = signal.astype(np.float64), list[float]()
    left = [slice(0, len(signal))]
    while left and len(slopes) * _STANDS <= len(signal):
        rows = left.pop()
        cut = _cut(beside[rows], deviation)
        if cut:
            left += [slice(rows.start, rows.start + cut), slice(rows.start + cut, rows.stop)]
            continue
        beside[rows] -= beside[rows].mean()
        along = np.arange(rows.stop - rows.start) - 0.5 * (rows.stop - rows.start - 1)
        by_chance = deviation * max(float(np.linalg.norm(along)), 1.0)
        slopes.append(float(along @ beside[rows]) / by_chance)
    stands = not left and np.mean(np.square(slopes)) < _RISING
    return beside if stands else None


def _cut(stretch: FloatArray, deviation: float) -> int:
    """Length of the first part of a stretch (n,) of two levels; 0 of one level."""
    n = len(stretch)
    if n < 2:
        return 0
    before = np.arange(1, n)
    apart = np.cumsum(stretch - stretch.mean())[:-1]
    sizes = np.abs(apart) / (deviation * np.sqrt(before * (n - before) / n))
    cut = int(np.argmax(sizes))
    return cut + 1 if sizes[cut] > _STEP else 0


_Fault = tuple[Kind, Callable[[DisturbedRun], FloatArray]]


def _output(j: int, run: DisturbedRun) -> FloatArray:
    return run.outputs[:, j]


def _input(i: int, run: DisturbedRun) -> FloatArray:
    return run.record.inputs[:, i]


def _faults(signal: Callable[[DisturbedRun], FloatArray], zeroed: bool) -> Iterator[_Fault]:
    if not zeroed:
        yield "offset", lambda run: np.ones(run.record.n_samples)
    yield "drift", _time
    yield "gain", signal
    yield "saturation", lambda run: _clipped(signal(run))


def _time(run: DisturbedRun) -> FloatArray:
    """Since a record's first sample."""
    return np.arange(run.record.n_samples, dtype=np.float64) * run.record.dt


def _unit(kind: Kind, unit: str) -> str:
    """Unit of a fault's size in a channel of this unit."""
    return {"offset": unit, "drift": f"{unit}/s"}.get(kind, "1")


def _clipped(signal: FloatArray) -> FloatArray:
    knee = _KNEE * np.abs(signal).max()
    clipped: FloatArray = np.clip(signal, -knee, knee) - signal
    return clipped


def _column(like: FloatArray, place: int, values: FloatArray) -> FloatArray:
    table = np.zeros(like.shape)
    table[:, place] = values
    return table


def variants_of(model: ProcessModel) -> Mapping[str, ProcessModel]:
    """The model's variants, used as it is: its outputs, its signals, its starts.

    Variants that lack one of its states are left out: their equations cannot be compared.
    """
    if model.variants is None:
        return {}
    variants: dict[str, ProcessModel] = {}
    for name, variant in model.variants().items():
        if variant.state_names == model.state_names and variant.input_names == model.input_names:
            like = replace(variant, states=model.states, inputs=model.inputs)
            variants[name] = like.with_outputs(model.output_names)
    return variants


def variant_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """What the model's variants add to its equations, for several values of their own parameters.

    Every column is a variant of its own, so that a sum of positive parts of them is one as well.
    """
    model, vector = runs[0].model, runs[0].vector
    values = dict(zip(model.parameter_names, vector.tolist(), strict=True))
    for name, variant in variants_of(model).items():
        shared = {k: v for k, v in values.items() if k in variant.parameter_names}
        at = variant.vector(shared)
        added = [i for i, k in enumerate(variant.parameter_names) if k not in values]
        free = [i for i in added if not variant.parameters[i].fixed]
        moved = [at, *(p for i in free for p in _moved(variant, at, i))]
        rates = zip(*(rates_of_each(runs, variant.derivative, p) for p in moved), strict=True)
        beside = [
            Rates.together([each - run.rates for each in several])
            for run, several in zip(runs, rates, strict=True)
        ]
        yield Suspect("variant", name, "", of_each(runs, DisturbedRun.added, beside))


def _moved(variant: ProcessModel, vector: FloatArray, place: int) -> Iterator[FloatArray]:
    """Parameters, one of which is moved by parts of its value, or both ways from zero."""
    parameter = variant.parameters[place]
    beside = 0.1 * (parameter.upper - parameter.lower)
    values = [vector[place] * part for part in _PARTS] if vector[place] else [-beside, beside]
    for value in values:
        moved = vector.copy()
        moved[place] = value
        yield moved


def function_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Functions of every state and input, added to every equation that parameters act in.

    Inputs of two levels show no function, but an offset. Of signals that jump from sample to
    sample, and are not held, the function between them is not known; of states that swing in a few
    samples nearly.
    """
    model = runs[0].model
    signals: list[State | Input] = [*model.states, *model.inputs]
    for i in physical_equations(runs[0]):
        for j, signal in enumerate(signals):
            together = np.concatenate([_signal(j, run) for run in runs])
            held = isinstance(signal, Input) and signal.hold == "zoh"
            noise = np.concatenate([np.zeros(len(model.states)), runs[0].record.input_noise])
            noisy = bool(noise[j])
            limit = _JUMPING_STATE if isinstance(signal, State) else _JUMPING
            if len(np.unique(together)) < _LEVELS or (_jumps(together, limit) and not held):
                continue
            for terms in _terms(model.states[i].name, signal, together):
                yield of_terms(runs, i, partial(_signal, j), terms, held=held, noisy=noisy)


def of_terms(
    runs: Sequence[DisturbedRun],
    i: int,
    signal: Callable[[DisturbedRun], FloatArray],
    terms: tuple[AddedTerm, ...],
    *,
    held: bool = False,
    noisy: bool = False,
) -> Suspect:
    """Functions of a signal (n_samples,) of each run, in equation i together.

    Of a noisy one, whose noise errors go with, straight from mean to mean of two samples.
    """
    state = runs[0].model.states[i]
    along = [partial(_along, term, signal, held and noisy) for term in terms]
    changes = added_rates(runs, i, along, held=held and not noisy)
    return Suspect("function", state.name, f"{state.unit}/s", changes, terms)


def _along(
    term: AddedTerm,
    signal: Callable[[DisturbedRun], FloatArray],
    evened: bool,
    run: DisturbedRun,
) -> FloatArray:
    values = _values(term, signal(run))
    return 0.5 * (values + delayed(values)) if evened else values


def _terms(
    equation: str, signal: State | Input, values: FloatArray
) -> Iterator[tuple[AddedTerm, ...]]:
    """Functions of a signal that are tested together; values: its own over all records.

    A straight line by itself; shapes that together are like most, an even one among them; more
    friction near standstill.
    """
    low, high = float(values.min()), float(values.max())
    centre = 0.0 if low < 0.0 < high else 0.5 * (low + high)
    size = max(high - centre, centre - low)

    def term(shape: Shape, part: float = 1.0) -> AddedTerm:
        scale, middle = _short(part * size), _short(centre)
        return AddedTerm(equation, signal.name, shape, scale, -1.0, 1.0, middle, signal.unit)

    if size == 0.0:
        return
    yield (term("linear"),)
    even = term("abs") if centre == 0.0 else term("parabola")
    yield term("sign", _STICTION), term("square"), term("cube"), even
    if signal.name == equation and centre == 0.0:
        yield tuple(term("stribeck", part) for part in _STANDSTILL)


def _short(value: float) -> float:
    """To be read and typed: no more than tells where a function is."""
    return float(f"{value:.2g}")


def _values(term: AddedTerm, signal: FloatArray) -> FloatArray:
    """A term along a signal; signs smoothly, and friction such that it brakes."""
    z = (signal - term.centre) / term.scale
    if term.shape == "sign":
        return np.tanh(_STICTION * z / _ROUNDED)
    if term.shape == "stribeck":
        return -np.sign(z) * np.exp(-(z**2))
    if term.shape == "abs":
        return np.abs(z)
    if term.shape == "sine":
        return np.sin(z)
    return {"linear": z, "square": z * np.abs(z), "cube": z**3, "parabola": z**2}[term.shape]


def curve_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Outputs that are logged along a curve, a parabola and a cube, as of a sensor that bends."""
    for j, output in enumerate(runs[0].model.outputs):
        signal = np.concatenate([run.outputs[:, j] for run in runs])
        centre, size = 0.5 * (signal.max() + signal.min()), 0.5 * np.ptp(signal)
        if size > 0.0:
            columns = [
                _logged(runs, j, partial(_curved, j, float(centre), float(size), power))
                for power in (2, 3)
            ]
            yield Suspect("curve", output.name, "1", np.stack(columns, axis=2))


def _curved(j: int, centre: float, size: float, power: int, run: DisturbedRun) -> FloatArray:
    curved: FloatArray = size * ((run.outputs[:, j] - centre) / size) ** power
    return curved


def disturbance_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Slow signals that nobody measured, a few periods of a record, added to every equation."""
    waves = [
        wave for k in _PERIODS for wave in (partial(_wave, np.sin, k), partial(_wave, np.cos, k))
    ]
    for i in physical_equations(runs[0]):
        state = runs[0].model.states[i]
        changes = added_rates(runs, i, waves)
        yield Suspect("disturbance", state.name, f"{state.unit}/s", changes)


def _wave(function: np.ufunc, periods: int, run: DisturbedRun) -> FloatArray:
    n = run.record.n_samples
    wave: FloatArray = function(2.0 * np.pi * periods * np.arange(n) / n)
    return wave


def fixed_suspects(runs: Sequence[DisturbedRun], names: Sequence[str]) -> Iterator[Suspect]:
    """Parameters, by name, that were held at a value from elsewhere, by parts of that value."""
    for name in names:
        moved = _with_more(name, runs[0])
        changes = of_each(runs, partial(_of_another_value, moved), followed(runs, moved))
        yield Suspect("fixed", name, "1", changes[..., None])


def _with_more(name: str, run: DisturbedRun) -> FloatArray:
    """The parameters (n_parameters,) of a run with a part more of the named one."""
    vector = run.vector.copy()
    vector[run.model.parameter_names.index(name)] *= 1.0 + PROBE
    return vector


def followed(runs: Sequence[DisturbedRun], moved: FloatArray) -> list[Rates]:
    """How each run's rates follow parameters (n_parameters,) that are moved by a part of something.

    By all of what acts, where that is in proportion to them.
    """
    rates = rates_of_each(runs, runs[0].model.derivative, moved)
    return [(each - run.rates) * (1.0 / PROBE) for run, each in zip(runs, rates, strict=True)]


def _of_another_value(moved: FloatArray, run: DisturbedRun, rates: Rates) -> FloatArray:
    """Change of the outputs by moved parameters, in the rates and in what is seen of the states."""
    seen, before = (
        observed(run.model, run.states, run.record.inputs, values) for values in (moved, run.vector)
    )
    return run.added(rates) + run.logged((seen - before) / PROBE)


def rest_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Equations that are others while a held input stands at zero, as behind a driver that opens.

    What acts then is told by the states: a winding that is open has no current, and its voltage,
    which would have braked, drives none.
    """
    model = runs[0].model
    for u, given in enumerate(model.inputs):
        share = np.mean(np.concatenate([_at_rest(u, run) for run in runs]))
        if given.hold != "zoh" or not _OFTEN < share < 1.0 - _OFTEN:
            continue
        for i in physical_equations(runs[0]):
            along = [partial(_while_at_rest, u, j) for j in range(len(model.states))]
            columns = added_rates(runs, i, along)
            name = f"d{model.states[i].name}/dt while {given.name} stands at 0"
            yield Suspect("rest", name, f"{model.states[i].unit}/s", columns, of_input=True)


def _at_rest(u: int, run: DisturbedRun) -> BoolArray:
    """Samples (n_samples,) of stretches in which an input stands at zero."""
    zero = run.record.inputs[:, u] == 0.0
    edges = np.flatnonzero(np.diff(zero, prepend=False, append=False))
    rest = np.zeros(len(zero), dtype=bool)
    for begin, end in edges.reshape(-1, 2).tolist():
        rest[begin:end] = end - begin >= _AT_REST
    return rest


def _while_at_rest(u: int, j: int, run: DisturbedRun) -> FloatArray:
    """State j (n_samples,) while an input stands at zero."""
    signal: FloatArray = np.where(_at_rest(u, run), run.states[:, j], 0.0)
    return signal


def change_suspects(runs: Sequence[DisturbedRun], names: Sequence[str]) -> Iterator[Suspect]:
    """Parameters, by name, that change in proportion to time from a record's begin to its end."""
    for name in names:
        changes = of_each(runs, _drifting, followed(runs, _with_more(name, runs[0])))
        yield Suspect("change", name, "1", changes[..., None])


def _drifting(run: DisturbedRun, rates: Rates) -> FloatArray:
    """Change by what is added to rates in proportion to time."""
    return run.added(rates * np.linspace(-0.5, 0.5, run.record.n_samples)[:, None])


def bend_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Parameters that change with the size of what they multiply, in all equations alike.

    As the stiffness of a spring between two states that hardens, or has play: no function of a
    single state tells that. Of a term in one equation that is one ``function_suspects`` tell more.
    """
    model, vector = runs[0].model, runs[0].vector
    signals = np.concatenate([np.hstack([run.states, run.record.inputs]) for run in runs])
    earlier: list[FloatArray] = []
    for place, name in enumerate(model.parameter_names):
        if model.parameters[place].minimum < 0.0:  # no stiffness, conductance, resistance
            continue
        moved = vector.copy()
        moved[place] += PROBE * (vector[place] or 1.0)
        terms = followed(runs, moved)
        whole = np.concatenate([term.after for term in terms])
        if not (np.all(np.isfinite(whole)) and np.any(whole)):
            continue
        main = int(np.argmax(np.mean(whole**2, axis=0)))
        along, acting = whole[:, main], int(np.count_nonzero(whole.any(axis=0)))
        if not all(_alike(whole[:, i], along) for i in range(whole.shape[1])):
            continue  # it multiplies several things
        if acting == 1 and any(_alike(signal, along) for signal in signals.T):
            continue
        if any(_alike(before, along) for before in earlier):
            continue
        earlier.append(along)
        size = float(np.abs(along).max())
        bent = [_bent(each, main, size) for each in terms]
        changes = of_each(runs, DisturbedRun.added, bent)
        yield Suspect("bend", name, "1", changes, _bends(model.states[main], name, size))


def _bends(state: State, name: str, size: float) -> tuple[AddedTerm, ...]:
    """Terms by which a parameter changes with its part of a state's rate, and with its square."""
    unit, scale = rate_unit(state.unit), _short(size)
    return tuple(AddedTerm(state.name, name, shape, scale, -1.0, 1.0, 0.0, unit) for shape in _BENT)


def _alike(values: FloatArray, along: FloatArray) -> bool:
    """Whether values are another signal's, (n,) each, times a number, which may be zero."""
    factor = (values @ along) / max(float(along @ along), 1e-300)
    error, size = np.abs(values - factor * along).max(), np.abs(values).max()
    return bool(size == 0.0 or (factor != 0.0 and error <= _PROPORTIONAL * size))


def _bent(terms: Rates, main: int, size: float) -> Rates:
    """Terms of a run times each of some functions of their size."""

    def sized(term: FloatArray, bend: Callable[[FloatArray], FloatArray]) -> FloatArray:
        return term * bend(np.abs(term[:, main]) / size)[:, None]

    return Rates.together([Rates(sized(terms.after, b), sized(terms.before, b)) for b in _BENDS])


def _jumps(signal: FloatArray, limit: float) -> bool:
    """Whether a signal changes from sample to sample by much of all that it changes."""
    return float(np.mean(np.diff(signal) ** 2)) > limit * float(np.var(signal))


def _signal(j: int, run: DisturbedRun) -> FloatArray:
    """Signal j, counted through states and inputs."""
    n = run.states.shape[1]
    return run.states[:, j] if j < n else run.record.inputs[:, j - n]


def added_rates(
    runs: Sequence[DisturbedRun],
    i: int,
    signals: Sequence[Callable[[DisturbedRun], FloatArray]],
    *,
    held: bool = False,
) -> FloatArray:
    """Changes (n_rows, n_outputs, k) by signals (n_samples,) of each run, one by one in equation i.

    held: whether they stand from each sample to the next.
    """

    def change(run: DisturbedRun) -> FloatArray:
        after = np.zeros((*run.states.shape, len(signals)))
        for place, signal in enumerate(signals):
            after[:, i, place] = signal(run)
        return run.added(Rates(after, delayed(after) if held else after))

    return of_each(runs, change)


def physical_equations(run: DisturbedRun) -> list[int]:
    """Equations in which a parameter acts: an angle is the integral of its speed and no more."""
    few: Any = np.linspace(0, run.record.n_samples - 1, _POINTS).astype(np.int64)
    rates = _rates_at(run, np.unique(few))
    moved = rates(run.vector * 1.01 + 1e-9)
    return np.flatnonzero(np.any(moved != rates(run.vector), axis=0)).tolist()


def _rates_at(run: DisturbedRun, rows: Any) -> Callable[[FloatArray], FloatArray]:
    """The model's rates at some rows of a run, as a function of the parameters."""
    points = list(zip(run.states[rows].tolist(), run.record.inputs[rows].tolist(), strict=True))

    def rates(vector: FloatArray) -> FloatArray:
        p = tuple(vector.tolist())
        values = []
        for x, u in points:
            try:
                values.append(run.model.derivative(tuple(x), tuple(u), p))
            except (ArithmeticError, ValueError):
                continue
        return np.array(values).reshape(-1, len(run.model.states))

    return rates


def head(records: Sequence[Dataset], samples: int) -> list[Dataset]:
    """The first records, and of the last of them the beginning, that hold so many samples."""
    kept: list[Dataset] = []
    for record in records:
        left = samples - sum(r.n_samples for r in kept)
        if left < 2:
            break
        short = record.n_samples <= left
        kept.append(record if short else record.part(0, left, record.name))
    return kept
