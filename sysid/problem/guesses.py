"""Starting ranges from measured data: a model's own rules of thumb, and where each came from.

A model that can tell something of its parameters from records has a ``guesses`` function:

    def guesses(records, known):
        ...
        return {"R": Guess(0.9, 1.3, "steady current over voltage in bench.csv")}

records: ``Measured``, signals by name. known: {parameter: (low, high)}, what is assumed of every
parameter so far, low = high for one that is fixed. What it does not return keeps its range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, Parameter, ProcessModel
from sysid.problem.ranges import Range, searched
from sysid.problem.space import SearchSpace
from sysid.threads import one_thread

Known = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Guess:
    """A range for a parameter and what it was read from; an end not told is None."""

    low: float | None
    high: float | None
    source: str


@dataclass(frozen=True)
class Measured:
    """A record whose signals go by name: ``record["omega"]``, ``"omega" in record``.

    Inputs and outputs are (n_samples,), outputs NaN where a sample was lost. An output is the
    value at the sample, before that sample's input is applied.
    """

    record: Dataset
    model: ProcessModel

    @property
    def name(self) -> str:
        """The record's name, for the text of a guess."""
        return self.record.name

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.record.dt

    def __contains__(self, signal: str) -> bool:
        return signal in self.model.input_names or signal in self.model.output_names

    def __getitem__(self, signal: str) -> FloatArray:
        if signal in self.model.input_names:
            column: FloatArray = self.record.inputs[:, self.model.input_names.index(signal)]
            return column
        if signal in self.model.output_names:
            column = self.record.outputs[:, self.model.output_names.index(signal)]
            return column
        raise ModelError(f"{self.name}: model {self.model.name} has no signal {signal!r} in it")


Guesses = Callable[[Sequence[Measured], Known], Mapping[str, Guess]]


def guess_ranges(
    model: ProcessModel,
    records: Sequence[Dataset],
    ranges: Mapping[str, Range] | None = None,
    fixed: Mapping[str, float] | None = None,
    tied: Mapping[str, str] | None = None,
) -> dict[str, Guess]:
    """Ranges that the records suggest for parameters of which nothing else is said.

    ranges, fixed and tied as in ``SearchSpace.of``; parameters named there keep what is said.
    A guess narrows the model's own range; one that lies outside of it takes its place. Both
    ends of what is returned are numbers within the physical limits. Raises ModelError for a
    model without a ``guesses`` function, or one that fails.
    """
    if model.guesses is None:
        raise ModelError(
            f"model {model.name} cannot guess ranges from data; give it a 'guesses' function, or "
            "leave guessing out"
        )
    space = SearchSpace.of(model, ranges, fixed, tied=tied)
    low, high = space.full(space.lower), space.full(space.upper)
    known = {
        name: (float(min(ends)), float(max(ends)))
        for name, *ends in zip(model.parameter_names, low, high, strict=True)
    }
    for record in records:
        record.check(model)
    with one_thread():
        told = _called(model, [Measured(record, model) for record in records], known)
    found = {}
    for parameter in space.parameters:
        given = told.get(parameter.name)
        if given is None or parameter.name in (ranges or {}):
            continue
        ends = _rounded(parameter, *_within(parameter, given))
        if ends != (parameter.lower, parameter.upper):
            found[parameter.name] = Guess(*ends, given.source)
    return found


def _called(model: ProcessModel, records: list[Measured], known: Known) -> Mapping[str, Guess]:
    assert model.guesses is not None
    where = f"model {model.name}: guesses(records, known)"
    try:
        told = dict(model.guesses(records, known))
    except ModelError:
        raise
    except Exception as error:
        raise ModelError(f"{where} fails: {type(error).__name__}: {error}") from error
    for name, guess in told.items():
        model.parameter(name)
        if not isinstance(guess, Guess):
            raise ModelError(f"{where} gives {guess!r} for {name}; return Guess(low, high, source)")
        ends = [end for end in (guess.low, guess.high) if end is not None]
        if not np.all(np.isfinite(ends)) or ends != sorted(ends):
            raise ModelError(f"{where} gives [{guess.low}, {guess.high}] for {name}; it must be "
                             "finite, low before high, None for an end not told")  # fmt: skip
    return told


def _within(parameter: Parameter, guess: Guess) -> tuple[float, float]:
    """The part of the parameter's range that the guess leaves; the guess, where that is none."""
    low = parameter.lower if guess.low is None else max(guess.low, parameter.lower)
    high = parameter.upper if guess.high is None else min(guess.high, parameter.upper)
    if low < high:
        return low, high
    inside = [
        None if end is None else min(max(end, parameter.minimum), parameter.maximum)
        for end in (guess.low, guess.high)
    ]
    try:
        elsewhere = searched(parameter, (inside[0], inside[1]), "linear")
    except ModelError:
        return parameter.lower, parameter.upper  # nothing that is physically possible
    return elsewhere.lower, elsewhere.upper


def _rounded(parameter: Parameter, low: float, high: float) -> tuple[float, float]:
    """Ends that are no range's own, to three digits outwards; a guess is no better than that."""
    rounded = []
    for end, outwards in ((low, math.floor), (high, math.ceil)):
        if end in (0.0, parameter.lower, parameter.upper, parameter.minimum, parameter.maximum):
            rounded.append(end)
            continue
        digit = 10.0 ** (math.floor(math.log10(abs(end))) - 2)
        rounded.append(float(f"{outwards(end / digit) * digit:.3g}"))
    return max(rounded[0], parameter.minimum), min(rounded[1], parameter.maximum)


def regression(
    target: FloatArray, columns: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray] | None:
    """Least squares of a target on columns: coefficients and their covariance.

    target and each column: (n,); rows with NaN do not count. None where the rows are too few or
    the columns do not tell the coefficients apart.
    """
    table = np.column_stack(columns)
    rows = np.isfinite(target) & np.isfinite(table).all(axis=1)
    table, wanted = table[rows], target[rows]
    n, m = table.shape
    if n < 2 * m + 2:
        return None
    size = np.abs(table).max(axis=0)
    if np.any(size == 0.0):
        return None
    q, triangle = np.linalg.qr(table / size)
    if np.abs(np.diag(triangle)).min() < 1e-9 * np.abs(np.diag(triangle)).max():
        return None
    inverse = np.linalg.inv(triangle)
    coefficients = inverse @ (q.T @ wanted)
    residual = wanted - (table / size) @ coefficients
    covariance = inverse @ inverse.T * (residual @ residual / (n - m))
    return coefficients / size, covariance / np.outer(size, size)
