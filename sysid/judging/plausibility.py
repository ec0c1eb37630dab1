"""Whether records can be of a model at all: units a factor off, starts elsewhere, before any fit.

Outputs of which the model says that one is the other's rate of change are compared. And it is
simulated under a record's inputs with parameters drawn from their ranges: where outputs are far
beyond all of these, a unit is another, or the ranges are.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.simulation import BatchSimulator
from sysid.problem.channels import noise
from sysid.problem.data import Dataset
from sysid.problem.faults import DataFault, Part
from sysid.problem.model import AROUND_FIRST_SAMPLE, ProcessModel, State
from sysid.problem.space import SearchSpace
from sysid.time_limit import AT_A_POINT, time_limit

_DRAWS = 32
_ROWS = 1000  # of a record's beginning that are simulated
_FAR = 0.25  # of the range of a start, by which a first sample is beyond it
_BEYOND = 4.0  # times the largest of all draws, which do not reach the ends of their ranges

# What people confuse, as the factor on the numbers.
_FACTORS = {
    180.0 / np.pi: "degrees for radians",
    np.pi / 180.0: "radians for degrees",
    60.0 / (2.0 * np.pi): "rpm for rad/s",
    2.0 * np.pi / 60.0: "rad/s for rpm",
    2.0 * np.pi: "radians for turns",
    0.5 / np.pi: "turns for radians",
    1e3: "thousandths, such as mA for A",
    1e-3: "thousands, such as A for mA",
}


def implausible(
    model: ProcessModel, space: SearchSpace, records: Sequence[Dataset], part: Part = "training"
) -> tuple[DataFault, ...]:
    """Faults of records by which they are no response of the model within its ranges.

    >>> from sysid.examples import lag, lag_record
    >>> log, space = lag_record(), SearchSpace.of(lag())
    >>> implausible(lag(), space, [log])
    ()
    >>> large = Dataset(log.inputs, 1000.0 * log.outputs, log.dt, "large")
    >>> implausible(lag(), space, [large])[0].kind
    'unit'
    """
    rates = tuple(_rates(model, records, part))
    if rates:
        return rates
    record = records[0].part(0, min(_ROWS, records[0].n_samples), records[0].name)
    model.require_ends(space.full(np.array([space.lower, space.upper])))
    simulator = BatchSimulator(model, accuracy=1e-2, max_steps=32)
    runs = _runs(simulator, _draws(space), record)
    # Ranges in which few sets simulate tell nothing.
    return tuple(_sizes(model, record, runs, part)) if len(runs) >= _DRAWS // 4 else ()


def _draws(space: SearchSpace) -> FloatArray:
    """Parameter vectors drawn evenly from their ranges, those that keep the constraints."""
    rng = np.random.default_rng(0)
    parts = rng.uniform(size=(4 * _DRAWS, len(space.parameters)))
    chromosomes = space.decode(space.coded_lower + parts * space.width)
    kept = chromosomes[space.violations(chromosomes).sum(axis=1) <= 0.0]
    return space.full(kept[:_DRAWS])


def _runs(simulator: BatchSimulator, vectors: FloatArray, record: Dataset) -> FloatArray:
    """Simulated outputs, (n_runs, n_samples, n_outputs), of the draws that simulate."""
    if not len(vectors):
        return np.empty((0, *record.outputs.shape))
    cheap = simulator.steps_of_each(vectors, record) < simulator.max_steps
    if not cheap.any():
        return np.empty((0, *record.outputs.shape))
    runs = simulator.trajectories(vectors[cheap], record)
    return runs[np.isfinite(runs).all(axis=(1, 2))]


def _sizes(
    model: ProcessModel, record: Dataset, runs: FloatArray, part: Part
) -> Iterator[DataFault]:
    """Outputs that move farther, or less far, than with any set of parameters drawn."""
    for j, output in enumerate(model.outputs):
        y = record.outputs[:, j]
        measured, simulated = float(np.nanstd(y)), np.std(runs[:, :, j], axis=1)
        low, high = simulated.min() / _BEYOND, simulated.max() * _BEYOND
        if measured <= 3.0 * noise(y) or not high > 0.0 or low <= measured <= high:
            continue
        ratio = measured / float(np.median(simulated))
        hint = _confusion(ratio, low / measured, high / measured)
        yield DataFault(
            kind="unit",
            severity="doubt",
            part=part,
            records=(record.name,),
            channel=output.name,
            statement=f"{output.name} moves {ratio:.3g} times as far as with parameters from the "
            f"middle of their ranges, and beyond what any of them give{hint}",
            effect="parameters take up the factor, or end at their ranges",
            cure=f"give the unit of its column ('columns: outputs: {output.name}: unit: ...') or "
            "of an input's, or other ranges",
            share=1.0,
            moves_parameters=part == "training",
        )


def _confusion(ratio: float, low: float, high: float) -> str:
    """The confusion of units nearest to a ratio that mends it; low, high: what it mends it to."""
    factor = min(_FACTORS, key=lambda each: abs(np.log(abs(ratio) / each)))
    return f", as with {_FACTORS[factor]}" if low <= 1.0 / factor <= high else ""


def start_faults(
    model: ProcessModel, records: Sequence[Dataset], part: Part = "training"
) -> tuple[DataFault, ...]:
    """Faults of records that begin elsewhere than where their starts are searched.

    >>> from dataclasses import replace
    >>> from sysid.examples import lag, lag_record
    >>> model = lag()
    >>> model = replace(model, states=(replace(model.states[0], initial_range=(5.0, 6.0)),))
    >>> fault, = start_faults(model, [lag_record()])
    >>> fault.kind, fault.channel, fault.settings
    ('start', 'y', ('initial.y=[-0.497, 6]',))
    """
    return tuple(
        fault
        for state in model.states
        if (fault := _start_fault(model, state, records, part)) is not None
    )


def _start_fault(
    model: ProcessModel, state: State, records: Sequence[Dataset], part: Part
) -> DataFault | None:
    if state.initial_range in (None, AROUND_FIRST_SAMPLE) or state.name not in model.output_names:
        return None
    assert state.initial_range is not None
    place, (low, high) = model.output_names.index(state.name), state.initial_range
    firsts = np.array([record.outputs[0, place] for record in records])
    margin = _FAR * (high - low)
    beyond = (firsts < low - margin) | (firsts > high + margin)
    if not beyond.any():
        return None
    at = int(np.flatnonzero(beyond)[0])
    reach = 2.0 * margin
    ends = min(low, firsts.min() - reach), max(high, firsts.max() + reach)
    wider = f"[{ends[0]:.3g}, {ends[1]:.3g}]"
    declared = [
        s.name for s in model.states if s.name not in model.output_names and s.initial_range is None
    ]
    hidden = f"; where it moves there, {' and '.join(declared)} as well" if declared else ""
    return DataFault(
        "start",
        "doubt",
        part,
        tuple(record.name for record, is_far in zip(records, beyond, strict=True) if is_far),
        state.name,
        f"{state.name} begins at {firsts[at]:.3g} {state.unit}, and its start is searched in "
        f"{low:g} .. {high:g}",
        "a simulation that begins elsewhere than the log follows it nowhere",
        f"give its start another range, 'initial: {{{state.name}: {wider}}}'{hidden}",
        1.0,
        part == "training",
        part == "validation",
        (f"initial.{state.name}={wider}",),
    )


def _rates(model: ProcessModel, records: Sequence[Dataset], part: Part) -> Iterator[DataFault]:
    """Outputs of which one is the other's rate of change in the model, but not as measured."""
    for j, i in _kinematic_pairs(model):
        ratios = [_rate_ratio(record, j, i) for record in records]
        clear = [ratio for ratio in ratios if np.isfinite(ratio)]
        if not clear:
            continue
        ratio = float(np.median(clear))
        if 0.9 < ratio < 1.1:
            continue
        angle, rate = model.outputs[j], model.outputs[i]
        turned = " and turned round" if ratio < 0.0 else ""
        hint = _confusion(ratio, 0.95 / abs(ratio), 1.05 / abs(ratio))
        yield DataFault(
            kind="unit",
            severity="doubt",
            part=part,
            records=tuple(record.name for record in records),
            channel=rate.name,
            statement=f"{rate.name} is {abs(ratio):.4g} times the rate of change of {angle.name}"
            f"{turned}{hint}",
            effect="the model takes them for one motion, and no parameters fit both",
            cure=f"give the unit or sign of its column ('columns: outputs: {rate.name}: unit: "
            f"..., sign: -1'), or of {angle.name}'s",
            share=1.0,
            moves_parameters=part == "training",
        )


def _kinematic_pairs(model: ProcessModel) -> list[tuple[int, int]]:
    """Outputs (j, i) that are states x_j, x_i with dx_j/dt = x_i whatever the parameters."""
    states = [name for name in model.output_names if name in model.state_names]
    rng = np.random.default_rng(0)
    places = {name: model.state_names.index(name) for name in states}
    pairs = {(a, b) for a in states for b in states if a != b}
    lower = np.array([p.nominal if p.fixed else p.lower for p in model.parameters])
    upper = np.array([p.nominal if p.fixed else p.upper for p in model.parameters])
    for _ in range(4):
        x = rng.uniform(0.1, 1.0, len(model.states))
        u = rng.uniform(0.1, 1.0, len(model.inputs))
        p = rng.uniform(lower, upper)
        try:
            with time_limit(AT_A_POINT):
                slope = model.derivative(tuple(x), tuple(u), tuple(p))
        except Exception:
            return []  # what a user's own function raises is said where it is simulated
        pairs = {(a, b) for a, b in pairs if slope[places[a]] == x[places[b]]}
    names = model.output_names
    return [(names.index(a), names.index(b)) for a, b in sorted(pairs)]


def _rate_ratio(record: Dataset, j: int, i: int) -> float:
    """What output i is in parts of the rate of change of output j; NaN where that is not clear."""
    angle, rate = record.outputs[:, j], record.outputs[:, i]
    good = np.isfinite(angle) & np.isfinite(rate)
    if good.sum() < 50:
        return np.nan
    # Both as changes over a tenth of the record, beside which noise and resolution are little.
    width = max(record.n_samples // 10, 5)
    travelled = np.cumsum(np.where(good, rate, 0.0)) * record.dt
    changes = angle[width:] - angle[:-width]
    expected = travelled[width:] - travelled[:-width]
    both = good[width:] & good[:-width]
    a, b = changes[both], expected[both]
    if len(a) < 20 or not a.std() > 0.0 or not b.std() > 0.0:
        return np.nan
    correlation = float(np.corrcoef(a, b)[0, 1])
    if abs(correlation) < 0.98:
        return np.nan
    return float(np.sign(correlation) * b.std() / a.std())
