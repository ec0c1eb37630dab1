"""Forces that repeat along a position, as the cogging of a motor's magnets or a gear's teeth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.disturbed import DisturbedRun
from sysid.judging.suspects import (
    SPEEDS,
    Suspect,
    of_terms,
    only,
    physical_equations,
    rows_of,
)
from sysid.problem.terms import AddedTerm

_MOST_CYCLES = 40  # within the range of a position, or in a turn
_FEWEST_SAMPLES = 4.0  # a cycle, where the position moves fast
_FAST = 0.95  # share of the samples in which it moves no faster
_PROPORTIONAL = 1e-9
# Cycles in the range of a position by which a period found is told more closely.
_CLOSER = np.linspace(-0.3, 0.3, 13)
_TURNS = {"rad": 2.0 * math.pi, "deg": 360.0}  # a turn of an angle in its unit
_SEEN = 0.3  # deviation from an output, in parts of its own, up to which a speed is that output


@dataclass(frozen=True)
class _Way:
    """A position and the equation of its speed, in which a force along it would act.

    along: the position in each run, (n_samples,). is_relative: whether that is from where the
    record begins, wherever on its way that is.
    """

    name: str
    unit: str
    equation: int
    along: Callable[[DisturbedRun], FloatArray]
    is_relative: bool = False


def cycle_suspects(runs: Sequence[DisturbedRun]) -> Iterator[Suspect]:
    """Sines of a position, of any phase, added to the equation of its speed.

    Periods are half a cycle apart in the range that the position runs through; of an angle that
    turns round they are whole parts of a turn.
    """
    for way in _ways(runs):
        positions = [way.along(run) for run in runs]
        steps = np.concatenate([np.abs(np.diff(position)) for position in positions])
        extent = float(np.ptp(np.concatenate(positions)))
        fast = float(np.quantile(steps, _FAST))
        if not extent > 0.0:
            continue
        turn = _TURNS.get(way.unit, math.inf)
        for cycles in _cycles(extent, turn):
            if cycles * _FEWEST_SAMPLES * fast > extent:
                break
            suspect = _cycle(runs, way, extent / cycles)
            if extent > turn:
                yield suspect
            else:
                periods = [extent / (cycles + part) for part in _CLOSER.tolist()]
                yield replace(suspect, closer=partial(_sized, runs, way, periods))


def _cycles(extent: float, turn: float) -> list[float]:
    """Cycles in the range of a position that are tested, the fewest first."""
    if extent > turn:
        return [n * extent / turn for n in range(1, _MOST_CYCLES + 1)]
    return [0.5 * k for k in range(2, 2 * _MOST_CYCLES + 1)]


def _sized(runs: Sequence[DisturbedRun], way: _Way, periods: Sequence[float]) -> list[Suspect]:
    return [_cycle(runs, way, period) for period in periods]


def _cycle(runs: Sequence[DisturbedRun], way: _Way, period: float) -> Suspect:
    """A sine and a cosine of this period in the position's unit."""
    equation, scale = runs[0].model.states[way.equation].name, period / (2.0 * math.pi)
    terms = tuple(
        AddedTerm(equation, way.name, "sine", scale, -1.0, 1.0, centre, way.unit)
        for centre in (0.0, -0.25 * period)
    )
    suspect = of_terms(runs, way.equation, way.along, terms)
    return _by_record(suspect, runs) if way.is_relative else suspect


def _by_record(suspect: Suspect, runs: Sequence[DisturbedRun]) -> Suspect:
    """The same with amplitudes of their own in every record."""
    changes = np.concatenate([only(rows, suspect.changes) for rows in rows_of(runs)], axis=2)
    return replace(suspect, changes=changes, terms=suspect.terms * len(runs))


def _ways(runs: Sequence[DisturbedRun]) -> Iterator[_Way]:
    """Positions that are states, and of speeds without one the way that was measured or run."""
    states, physical = runs[0].model.states, physical_equations(runs[0])
    placed = set()
    for position, speed in _positions(runs, physical):
        placed.add(speed)
        along = partial(_state, position)
        yield _Way(states[position].name, states[position].unit, speed, along)
    for speed in physical:
        state = states[speed]
        if speed not in placed and state.unit in SPEEDS:
            along = partial(_integral, speed)
            yield _Way(f"the integral of {state.name}", state.unit[:-2], speed, along, True)


def _state(j: int, run: DisturbedRun) -> FloatArray:
    return run.states[:, j]


def _integral(speed: int, run: DisturbedRun) -> FloatArray:
    """The way since a record's first sample, (n_samples,), as measured where the speed is.

    That of the run goes astray by more than a cycle.
    """
    passed = run.states[:, speed]
    away = np.sqrt(np.mean((run.outputs - passed[:, None]) ** 2, axis=0))
    nearest = int(np.argmin(away))
    if away[nearest] < _SEEN * np.std(passed):
        measured = run.record.outputs[:, nearest]
        passed = np.where(np.isfinite(measured), measured, passed)
    way: FloatArray = np.cumsum(passed) * run.record.dt
    return way


def _positions(runs: Sequence[DisturbedRun], physical: Sequence[int]) -> Iterator[tuple[int, int]]:
    """States whose rate is in proportion to another in whose equation a parameter acts."""
    states = np.concatenate([run.states for run in runs])
    rates = np.concatenate([run.rates.after for run in runs])
    for position in range(states.shape[1]):
        rate = rates[:, position]
        if position in physical or not np.any(rate):
            continue
        for speed in physical:
            factor = (rate @ states[:, speed]) / max(states[:, speed] @ states[:, speed], 1e-300)
            if np.abs(rate - factor * states[:, speed]).max() < _PROPORTIONAL * np.abs(rate).max():
                yield position, speed
