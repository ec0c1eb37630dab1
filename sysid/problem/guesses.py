"""Starting ranges from measured data: a model's rules of thumb, and where each came from.

A model that can read ranges of its parameters from records has a ``guesses`` function:

    def guesses(records, known):
        ...
        return {"R": Guess(0.9, 1.3, "steady current over voltage in bench.csv")}

records: ``Measured``, signals by name. known: {parameter: (low, high)}, the range assumed of each
parameter so far, low = high for a fixed one. A parameter that it does not return keeps its range.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, Parameter, ProcessModel
from sysid.problem.ranges import Range, with_search_range
from sysid.problem.space import SearchSpace
from sysid.threads import one_thread
from sysid.time_limit import AT_LENGTH, time_limit

Known = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Guess:
    """A range for a parameter and what it was read from; an open end is None.

    >>> Guess(0.9, None, "steady current over voltage in bench.csv").low
    0.9
    """

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
        if signal not in self:
            raise ModelError(f"{self.name}: model {self.model.name} has no signal {signal!r} in it")
        if signal in self.model.input_names:
            return self.record.inputs[:, self.model.input_names.index(signal)]
        return self.record.outputs[:, self.model.output_names.index(signal)]


Guesses = Callable[[Sequence[Measured], Known], Mapping[str, Guess]]


def guess_ranges(
    model: ProcessModel,
    records: Sequence[Dataset],
    ranges: Mapping[str, Range] | None = None,
    fixed: Mapping[str, float] | None = None,
    tied: Mapping[str, str] | None = None,
) -> dict[str, Guess]:
    """Ranges that the records suggest for parameters whose range is not given.

    ranges, fixed and tied as in ``SearchSpace.of``; parameters named there keep what is given.
    A guess narrows the model's declared range, or replaces it where they do not overlap. Both
    ends of what is returned are numbers within the physical limits. Raises ModelError for a
    model without a ``guesses`` function, or one that fails.

    >>> from dataclasses import replace
    >>> from sysid.examples import lag, lag_record
    >>> def guesses(records, known):
    ...     peak = max(abs(record["y"]).max() for record in records)
    ...     return {"gain": Guess(peak, None, "largest output under 1 V")}
    >>> guess_ranges(replace(lag(), guesses=guesses), [lag_record()])
    {'gain': Guess(low=2.83, high=20.0, source='largest output under 1 V')}
    """
    if model.guesses is None:
        raise ModelError(
            f"model {model.name} cannot guess ranges from data; give it a 'guesses' function, or "
            "leave guessing out"
        )
    space = SearchSpace.of(model, ranges, fixed, tied=tied)
    ends = np.sort([space.full(space.lower), space.full(space.upper)], axis=0)
    assumed = dict(zip(model.parameter_names, map(tuple, ends.T.tolist()), strict=True))
    for record in records:
        record.check(model)
    with one_thread():
        guesses = _guesses(model, [Measured(record, model) for record in records], assumed)
    narrowed = {}
    for parameter in space.parameters:
        guess = guesses.get(parameter.name)
        if guess is None or parameter.name in (ranges or {}):
            continue
        range_ = _rounded(parameter, *_within(parameter, guess))
        if range_ != (parameter.lower, parameter.upper):
            narrowed[parameter.name] = Guess(*range_, guess.source)
    return narrowed


def _guesses(model: ProcessModel, records: list[Measured], assumed: Known) -> dict[str, Guess]:
    """What the model's function returns, checked."""
    assert model.guesses is not None
    where = f"model {model.name}: guesses(records, known)"
    try:
        with time_limit(AT_LENGTH):
            guesses = dict(model.guesses(records, assumed))
    except ModelError:
        raise
    except Exception as error:
        raise ModelError(f"{where} fails: {type(error).__name__}: {error}") from error
    for name, guess in guesses.items():
        model.parameter(name)
        if not isinstance(guess, Guess):
            raise ModelError(f"{where} gives {guess!r} for {name}; return Guess(low, high, source)")
        ends = [end for end in (guess.low, guess.high) if end is not None]
        if not np.all(np.isfinite(ends)) or ends != sorted(ends):
            raise ModelError(
                f"{where} gives [{guess.low}, {guess.high}] for {name}; it must be finite, low "
                "before high, None for an end not told"
            )
    return guesses


def _within(parameter: Parameter, guess: Guess) -> tuple[float, float]:
    """The part of the declared range that the guess leaves; the guess where that is none."""
    low = parameter.lower if guess.low is None else max(guess.low, parameter.lower)
    high = parameter.upper if guess.high is None else min(guess.high, parameter.upper)
    if low < high:
        return low, high
    low_end, high_end = (
        None if end is None else min(max(end, parameter.minimum), parameter.maximum)
        for end in (guess.low, guess.high)
    )
    try:
        elsewhere = with_search_range(parameter, (low_end, high_end), "linear")
    except ModelError:
        return parameter.lower, parameter.upper  # nothing that is physically possible
    return elsewhere.lower, elsewhere.upper


def _rounded(parameter: Parameter, low: float, high: float) -> tuple[float, float]:
    """Ends read from data to three digits, outwards: a guess is no better than that."""
    exact = (0.0, parameter.lower, parameter.upper, parameter.minimum, parameter.maximum)

    def rounded(end: float, outwards: Callable[[float], float]) -> float:
        if end in exact:
            return end
        digit = 10.0 ** (math.floor(math.log10(abs(end))) - 2)
        return float(f"{outwards(end / digit) * digit:.3g}")

    return (
        max(rounded(low, math.floor), parameter.minimum),
        min(rounded(high, math.ceil), parameter.maximum),
    )


def regression(
    target: FloatArray, columns: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray] | None:
    """Least squares of a target on columns: coefficients and their covariance.

    target and each column: (n,); rows with NaN do not count. None where the rows are too few or
    the columns do not tell the coefficients apart.

    >>> t = np.arange(9.0)
    >>> coefficients, covariance = regression(2.0 * t - 1.0, [t, np.ones(9)])
    >>> coefficients.round(9).tolist()
    [2.0, -1.0]
    """
    table = np.column_stack(columns)
    rows = np.isfinite(target) & np.isfinite(table).all(axis=1)
    table, target = table[rows], target[rows]
    n, m = table.shape
    if n < 2 * m + 2:
        return None
    size = np.abs(table).max(axis=0)
    if np.any(size == 0.0):
        return None
    q, triangle = np.linalg.qr(table / size)
    diagonal = np.abs(np.diag(triangle))
    if diagonal.min() < 1e-9 * diagonal.max():
        return None
    inverse = np.linalg.inv(triangle)
    coefficients = inverse @ (q.T @ target)
    residual = target - (table / size) @ coefficients
    covariance = inverse @ inverse.T * (residual @ residual / (n - m))
    return coefficients / size, covariance / np.outer(size, size)
