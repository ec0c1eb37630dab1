"""Records that a model is looked at in: starts, inputs, and every branch of its conditions."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.tape import Tape
from sysid.identifiability.germ import Equations
from sysid.problem.model import ModelError, State

_RECORDS = 2  # what one experiment leaves open another may tell
_MOST_ORDERS = 200  # coefficients of inputs, beyond which they are zero
_CANDIDATES = 96  # points among which the branches of a model's conditions are looked for
_NEAR, _FAR = (-1.0, 1.0), (-2.5, 3.5)  # decades in which values without a range are drawn
_ATTEMPTS = 50  # to find a point at which the equations can be evaluated

# A condition, by what it compares, and how it is decided.
Outcome = tuple[int, float]
# Two of them together: what tells gamma |omega| z from beta omega |z| is a z against the motion.
Pair = tuple[Outcome, Outcome]


def _sign(operand: float, value: float) -> float:
    return math.copysign(1.0, operand)


def _step(operand: float, value: float) -> float:
    """The step on which a staircase stands, those far out alike."""
    return float(min(max(value, -2.0), 2.0))


# What switches without a condition: how its branch is named, and by which operand.
_SWITCHES = {
    "abs({})": (_sign, 0),
    "math.fabs({})": (_sign, 0),
    "math.copysign({}, {})": (_sign, 1),
    "math.floor({})": (_step, 0),
    "math.ceil({})": (_step, 0),
    "{} // {}": (_step, 0),
}


@dataclass(frozen=True)
class Record:
    """Where a record begins, and which of its states the analysis counts as unknown there.

    start: (n_states,). unknown: places of states. inputs: (n_inputs, n_orders), coefficients of
    their power series.
    """

    start: FloatArray
    unknown: tuple[int, ...]
    inputs: FloatArray

    def started(self, values: Sequence[float], unknown: Sequence[int]) -> "Record":
        """The same record with other starts of these states."""
        start = self.start.copy()
        start[list(unknown)] = values
        return replace(self, start=start)


class RecordPlan:
    """Draws records for a model whose named states have unknown starts.

    Of the other states those that are measured begin at their first sample, which may be
    anywhere, and the rest where the model declares.
    """

    def __init__(
        self, equations: Equations, unknown: Sequence[int], rng: np.random.Generator
    ) -> None:
        self.equations, self.unknown, self._rng = equations, tuple(unknown), rng
        model = equations.model
        self._measured = [
            state.first_sample and state.name in model.output_names for state in model.states
        ]

    def records(self, parameters: FloatArray, starts: FloatArray | None = None) -> list[Record]:
        """Records that begin as declared, then some that visit the branches of all conditions.

        Every two conditions are decided in every way in which they are at some point.

        starts: (n_records, n_unknown), values of the unknown starts of the first records.
        """
        given = [] if starts is None else list(starts)
        count = max(_RECORDS, len(given))
        drawn = [self._evaluable(parameters, False) for _ in range(count)]
        records = [record for record, _ in drawn]
        for k, values in enumerate(given):
            records[k] = records[k].started(values, self.unknown)
        if not any(outcomes for _, outcomes in drawn):
            return records
        candidates = [self._evaluable(parameters, True) for _ in range(_CANDIDATES)]
        visited: set[Pair] = set()
        while True:
            record, outcomes = max(candidates, key=lambda c: len(c[1] - visited))
            if outcomes <= visited:
                return records
            visited |= outcomes
            records.append(record)

    def _evaluable(self, parameters: FloatArray, late: bool) -> tuple[Record, set[Pair]]:
        """A record at whose start the equations have values, and how conditions are decided."""
        for _ in range(_ATTEMPTS):
            record = self._drawn(late)
            try:
                return record, self._outcomes(parameters, record)
            except ModelError:
                raise
            except (ArithmeticError, ValueError):
                continue
        raise ModelError(
            f"model {self.equations.model.name}: its equations have no value at {_ATTEMPTS} points "
            "drawn at random; declare starts of the states near which they have"
        )

    def _drawn(self, late: bool) -> Record:
        """late: in the middle of a record, where every state that is not measured is unknown."""
        # Limits may be far out; where all is large, smooth functions are flat.
        rng = self._rng
        spread = _FAR if late and rng.random() < 0.5 else _NEAR
        states = self.equations.model.states
        moving = [i for i in range(len(states)) if late and not self._measured[i]]
        unknown = tuple(sorted({*self.unknown, *moving}))
        start = self.equations.model.initial_state
        for i, state in enumerate(states):
            if i in unknown or self._measured[i]:
                start[i] = _start(state, spread, rng)
        n_inputs = len(self.equations.model.inputs)
        inputs = rng.standard_normal((n_inputs, _MOST_ORDERS))
        inputs[:, 0] = [_magnitude(rng, spread) * rng.choice((-1.0, 1.0)) for _ in range(n_inputs)]
        return Record(start, unknown, inputs)

    def _outcomes(self, parameters: FloatArray, record: Record) -> set[Pair]:
        point = {f"p{j}": value for j, value in enumerate(parameters.tolist())}
        point |= {f"x{i}": value for i, value in enumerate(record.start.tolist())}
        point |= {f"u{j}": value for j, value in enumerate(record.inputs[:, 0].tolist())}
        tape = Tape(point)
        names = self.equations.trace(tape)
        if not all(math.isfinite(tape.value(name)) for name in names):
            raise ArithmeticError("a rate is not finite")
        return _decided(tape)


def _decided(tape: Tape) -> set[Pair]:
    """How all that switches on a tape stands at its point, two by two."""
    keys: dict[str, int] = {}
    outcomes: set[Outcome] = set()
    for line in tape.lines:
        key = hash((line.form, *(keys.get(operand, hash(operand)) for operand in line.operands)))
        keys[line.name] = key
        if line.name in tape.decisions:
            outcomes.add((key, float(tape.decisions[line.name])))
        elif line.form in _SWITCHES:
            switch, place = _SWITCHES[line.form]
            outcomes.add((key, switch(tape.value(line.operands[place]), tape.value(line.name))))
    return set(itertools.combinations_with_replacement(sorted(outcomes), 2))


def _start(state: State, spread: tuple[float, float], rng: np.random.Generator) -> float:
    """A start anywhere in a state's range, else of about its declared size, or of any size."""
    if state.initial_range is not None and np.all(np.isfinite(state.initial_range)):
        return float(rng.uniform(*state.initial_range))
    if state.initial != 0.0:
        return state.initial * _magnitude(rng, spread)
    return float(_magnitude(rng, spread) * rng.choice((-1.0, 1.0)))


def _magnitude(rng: np.random.Generator, spread: tuple[float, float]) -> float:
    return float(10.0 ** rng.uniform(*spread))
