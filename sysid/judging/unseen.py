"""What may always be there, would not be seen in these data, and would move parameters.

Every shaft rubs and every sensor has a zero. Where an experiment makes such a thing look like what
the parameters do, as dry friction of what turns one way only looks like viscous one, no residual
tells: the fit takes it up, and intervals, which know nothing of it, are far too narrow.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray, IntArray
from sysid.judging.disturbed import DisturbedRun
from sysid.judging.suspects import (
    PROBE,
    SPEEDS,
    Suspect,
    added_rates,
    followed,
    physical_equations,
)

# Dry friction in parts of the largest that acts on a speed, and offsets in parts of a channel's
# largest value, delays in parts of a sample: as is usual.
_FRICTION, _OFFSET, _DELAY = 0.05, 0.01, 0.1
_RATHER = 0.1  # part by which a term may differ from friction and still be some
_ROUNDED = 0.01  # of a speed's largest, below which the sign of a wrong run is not known
_POINTS = 50


@dataclass(frozen=True, eq=False)
class Possibility:
    """A suspect that needs no evidence, how large it may usually be, and what would show it.

    words: what it is, with a place for its size; size: in a unit that the words have, of one unit
    of the suspect's amplitude.
    """

    suspect: Suspect
    usual: float
    words: str
    size: float
    unit: str
    cure: str


def possibilities(
    runs: Sequence[DisturbedRun], channels: Sequence[Suspect]
) -> Iterator[Possibility]:
    """Offsets and delays of the channels' suspects, and dry friction of speeds without any."""
    model = runs[0].model
    inputs, outputs = (
        np.abs(np.concatenate(values)).max(axis=0).tolist()
        for values in ([run.record.inputs for run in runs], [run.outputs for run in runs])
    )
    largest = dict(zip(model.input_names, inputs, strict=True))
    largest |= dict(zip(model.output_names, outputs, strict=True))
    for suspect in channels:
        if suspect.kind == "offset" and suspect.name in largest:
            words = f"that {suspect.name} is up to {{size}} off"
            cure = f"Take the zero of {suspect.name} at rest, in a calibration."
            usual = _OFFSET * largest[suspect.name]
            yield Possibility(suspect, usual, words, 1.0, suspect.unit, cure)
    yield from _delays(runs[0], channels)
    for i in physical_equations(runs[0]):
        if model.states[i].unit in SPEEDS and not _rubs(runs, i):
            yield _friction(runs, i)


def _delays(run: DisturbedRun, channels: Sequence[Suspect]) -> Iterator[Possibility]:
    """Inputs that act later than they are logged, within a sample, for drivers take their time.

    None of which it is told already how late.
    """
    usual, as_logged = _DELAY * run.record.dt, run.record.last_part == 0.0
    for name in itertools.compress(run.model.input_names, as_logged.tolist()):
        late = next((s.late for s in channels if s.kind == "delay" and s.name == name), None)
        if late is not None:
            suspect = Suspect("delay", name, "s", late(-usual) / usual, of_input=True)
            words = f"that {name} acts up to {{size}} later than it is logged"
            cure = f"A faster log tells, or a scope that shows {name}: 'delay' takes it out then."
            yield Possibility(suspect, usual, words, 1.0, "s", cure)


def _friction(runs: Sequence[DisturbedRun], i: int) -> Possibility:
    """Dry friction in the equation of a speed."""
    state = runs[0].model.states[i]
    speeds = np.concatenate([run.states[:, i] for run in runs])
    rounded = _ROUNDED * float(np.abs(speeds).max())

    def braking(run: DisturbedRun) -> FloatArray:
        sign: FloatArray = -np.tanh(run.states[:, i] / max(rounded, 1e-300))
        return sign

    changes = added_rates(runs, i, [braking])
    suspect = Suspect("function", state.name, f"{state.unit}/s", changes)
    low, high = float(speeds.min()), float(speeds.max())
    one_way = low > -_RATHER * high or high < -_RATHER * low
    cure = (
        f"{state.name} never turns round in them: a record that moves both ways tells."
        if one_way
        else f"A record in which {state.name} moves both ways, slowly and fast, tells."
    )
    factor, unit = _as_input(runs[0], i)
    usual = _FRICTION * _acting(runs, i)
    return Possibility(
        suspect, usual, f"dry friction of {state.name} of up to {{size}}", factor, unit, cure
    )


def _acting(runs: Sequence[DisturbedRun], i: int) -> float:
    """Root mean square of the largest of the terms that parameters have in an equation."""
    sizes, more = [0.0], np.diag(PROBE * runs[0].vector)
    for moved in runs[0].vector + more:
        term = np.concatenate([rates.after[:, i] for rates in followed(runs, moved)])
        sizes.append(float(np.sqrt(np.mean(term**2))))
    return max(size for size in sizes if np.isfinite(size))


def _rubs(runs: Sequence[DisturbedRun], i: int) -> bool:
    """Whether a parameter has a term that turns with a speed's sign and not with its size."""
    run = runs[0]
    speeds = run.states[:, i]
    fast = np.flatnonzero(np.abs(speeds) > 0.5 * np.abs(speeds).max())
    rows = fast[np.unique(np.linspace(0, len(fast) - 1, _POINTS).astype(np.int64))]
    for place in np.flatnonzero(run.vector).tolist():
        moved = run.vector.copy()
        moved[place] *= 1.0 + PROBE
        along, faster, back = (
            _rate(run, rows, i, factor, moved) - _rate(run, rows, i, factor, run.vector)
            for factor in (1.0, 2.0, -1.0)
        )
        size = float(np.abs(along).max())
        if size > 0.0 and all(
            float(np.abs(e).max()) < _RATHER * size for e in (faster - along, back + along)
        ):
            return True
    return False


def _rate(
    run: DisturbedRun, rows: IntArray, i: int, factor: float, vector: FloatArray
) -> FloatArray:
    """Rates (n,) of a speed at some rows of a run, were it so many times as fast."""
    p, rates = tuple(vector.tolist()), []
    for x, u in zip(run.states[rows].tolist(), run.record.inputs[rows].tolist(), strict=True):
        x[i] *= factor
        try:
            rates.append(run.model.derivative(tuple(x), tuple(u), p)[i])
        except (ArithmeticError, ValueError):
            rates.append(np.nan)
    return np.array(rates, dtype=np.float64)


def _as_input(run: DisturbedRun, i: int) -> tuple[float, str]:
    """How much of an input a unit of an equation's rate is, if any acts on it alike throughout."""
    state = run.model.states[i]
    for k, given in enumerate(run.model.inputs):
        span = float(np.abs(run.record.inputs[:, k]).max())
        if span == 0.0:
            continue
        moved = np.zeros_like(run.record.inputs)
        moved[:, k] = PROBE * span
        slopes = (run.rates_by(moved) - run.rates.after)[:, i] / (PROBE * span)
        size = float(np.abs(slopes).max())
        if size > 0.0 and float(np.ptp(slopes)) < PROBE * size:
            return 1.0 / size, given.unit
    return 1.0, f"{state.unit}/s"
