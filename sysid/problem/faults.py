"""What is wrong with records before anything is fitted to them, and what it does to parameters."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.problem.channels import (
    MEDIAN_OF_NORMAL,
    coarse_steps,
    noise,
    off_neighbours,
    pile_ups,
    spikes,
    standstill,
)
from sysid.problem.copies import shared_samples
from sysid.problem.data import Dataset
from sysid.problem.model import Input, Output, ProcessModel

Part = Literal["training", "validation"]
Severity = Literal["doubt", "note"]
FaultKind = Literal[
    "clipped",
    "frozen",
    "outliers",
    "coarse",
    "copy",
    "still",
    "constant",
    "gap",
    "unit",
    "lag",
    "start",
    "place",
]

Role = Literal["command", "input", "sensor"]

_COPIED = 0.2  # of a record's moving rows, beyond which it is no other record
_STILL = 0.05  # of the motion in training, below which a record does not move
_LONG = 10  # samples lost in a row that are many
_STRAIGHT = 1e-9  # of an input, by which rounding bends a straight line
_ENOUGH = 0.3  # of a record, that is worth to be fitted by itself
_GROSS = 5.0  # of a command's deviation, beyond which a single value is no command
_IN_VALIDATION = "no parameter comes of it, but errors in validation do"
_LEFT_OUT = "as 'robust: true' has it, these samples count as not measured"
_BY_NOISE = 7.0  # deviations of noise that a sample may be off its neighbours for no other reason
_ACCOUNTED = 0.5  # of how far a sample stands off, that a model may leave to explain it
_COARSE = 16  # steps in a channel's span, below which they are seen in the parameters


@dataclass(frozen=True)
class DataFault:
    """A fault of the data in a channel, or in whole records where ``channel`` is empty.

    statement: what is wrong, with its numbers; effect: what it does to the parameters or to what
    is said of them; cure: how to mend it. severity: ``doubt`` where a result may be wrong by it,
    ``note`` where the user has to judge. share: of the samples of the worst record, the first of
    ``records``. moves_parameters: whether it biases parameters beyond what their intervals know.
    voids_validation: whether it makes the errors in validation no evidence. settings: ``KEY=VALUE``
    of an identification's configuration that take it out.

    >>> fault = DataFault("still", "doubt", "validation", ("rest",), "", "it does not move",
    ...     "a validation that does not move is none", "validate with another log", 1.0,
    ...     moves_parameters=False, voids_validation=True)
    >>> fault.sentence
    'rest: it does not move: a validation that does not move is none. Validate with another log.'
    """

    kind: FaultKind
    severity: Severity
    part: Part
    records: tuple[str, ...]
    channel: str
    statement: str
    effect: str
    cure: str
    share: float
    moves_parameters: bool = False
    voids_validation: bool = False
    settings: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """All of it in words."""
        more = f" (and {len(self.records) - 1} more)" if len(self.records) > 1 else ""
        cure = f" {self.cure[:1].upper()}{self.cure[1:]}." if self.cure else ""
        return f"{self.records[0]}{more}: {self.statement}: {self.effect}.{cure}"


def data_faults(
    model: ProcessModel, training: Sequence[Dataset], validation: Sequence[Dataset] = ()
) -> tuple[DataFault, ...]:
    """Faults of records, the gravest first; each kind once for a channel and part.

    >>> from sysid.examples import lag, lag_record
    >>> log = lag_record()
    >>> data_faults(lag(), [log])
    ()
    >>> copied, = data_faults(lag(), [log], [log.part(0, 200, "copy")])
    >>> copied.kind, copied.voids_validation
    ('copy', True)
    """
    faults = [*_copies(training, validation), *_stillness(model, training, validation)]
    parts: tuple[tuple[Part, Sequence[Dataset]], ...]
    parts = ("training", training), ("validation", validation)
    for part, records in parts:
        for record in records:
            faults += _in_record(model, record, part)
    return tuple(sorted(_merged(faults), key=lambda fault: fault.severity))


def mended(model: ProcessModel, record: Dataset) -> Dataset:
    """A record whose faulty samples count as not measured: outliers, clipped, hanging ones.

    Outliers of inputs are replaced by what stands before and behind them. A first sample stays, as
    it tells where a simulation starts.

    >>> from sysid.examples import lag, lag_record
    >>> log = lag_record()
    >>> log.outputs[50] += 10.0
    >>> np.flatnonzero(np.isnan(mended(lag(), log).outputs))
    array([50])
    """
    inputs, outputs = record.inputs.copy(), record.outputs.copy()
    for j, column in enumerate(outputs.T):
        averaged = _averaged(record, j)
        jolts = spikes(column, record.inputs, averaged)
        hang = standstill(column, record.inputs, averaged)
        tests = (jolts, hang, *pile_ups(column))
        wrong = np.zeros(len(column), dtype=np.bool_)
        for test in tests:
            wrong |= test.at if test is not None else False
        column[1:][wrong[1:]] = np.nan
    rows = np.arange(record.n_samples)
    for j, column in enumerate(inputs.T):
        jolts = spikes(column, np.delete(record.inputs, j, axis=1), np.zeros(len(column)))
        if jolts is not None and _role(model, record, j) != "command":
            good = ~jolts.at
            column[:] = np.interp(rows, rows[good], column[good])
    return replace(record, inputs=inputs, outputs=outputs)


def after_mending(faults: Sequence[DataFault], model: ProcessModel) -> tuple[DataFault, ...]:
    """What is left of faults where records are ``mended``: those samples are mentioned only."""
    return tuple(
        replace(fault, severity="note", effect=_LEFT_OUT, cure="", moves_parameters=False)
        if (fault.kind in {"clipped", "frozen"} and fault.channel in model.output_names)
        or (fault.kind == "outliers" and fault.severity == "doubt")
        else fault
        for fault in faults
    )


def after_explaining(
    faults: Sequence[DataFault],
    model: ProcessModel,
    part: Part,
    runs: Sequence[tuple[Dataset, FloatArray, FloatArray]],
) -> tuple[DataFault, ...]:
    """Faults without outputs' samples that stand off their neighbours, where a model's do as well.

    As a current at which a shaft is stopped; or where nothing stands off in what a model leaves, as
    of an amplifier at the end of its range, whose every jolt hangs on what went before. runs:
    records of a part, free runs of the model on them, (n_samples, n_outputs), and what these leave,
    evened as of ``ExpectedErrors``.
    """
    return tuple(
        fault
        for fault in faults
        if (fault.kind, fault.part) != ("outliers", part)
        or fault.channel not in model.output_names
        or not all(
            _explains(record, run, evened, model.output_names.index(fault.channel))
            for record, run, evened in runs
            if record.name in fault.records
        )
    )


def _explains(record: Dataset, run: FloatArray, evened: FloatArray, output: int) -> bool:
    """Whether of each sample that stands off a run leaves less than half, or no more than noise."""
    values = record.outputs[:, output]
    jolts = spikes(values, record.inputs, _averaged(record, output))
    if jolts is None:  # none are left in it
        return False
    off, left, beside = (
        np.abs(off_neighbours(signal))
        for signal in (values, values - run[:, output], evened[:, output])
    )
    usual = np.nanmedian(beside) / MEDIAN_OF_NORMAL
    explained = (left < _ACCOUNTED * off) | (beside < _BY_NOISE * usual)
    return bool(np.all(explained[jolts.at]))


def _merged(faults: Sequence[DataFault]) -> list[DataFault]:
    """One fault for all records in which it is the same, described by the worst of them.

    Those of training come first, as they are what parameters come from; what makes a validation
    none is a fault by itself.
    """
    alike: dict[tuple[object, ...], list[DataFault]] = {}
    for fault in faults:
        key = fault.kind, fault.severity, fault.channel, fault.voids_validation
        alike.setdefault(key, []).append(fault)
    merged = []
    for group in alike.values():
        ordered = sorted(group, key=lambda fault: (fault.part == "validation", -fault.share))
        records = dict.fromkeys(name for fault in ordered for name in fault.records)
        settings = dict.fromkeys(setting for fault in ordered for setting in fault.settings)
        merged.append(replace(ordered[0], records=tuple(records), settings=tuple(settings)))
    return merged


def _in_record(model: ProcessModel, record: Dataset, part: Part) -> Iterator[DataFault]:
    """Faults of a record's channels, and its gaps."""
    yield from _gaps(record, part)
    for j, u in enumerate(model.inputs):
        role, others = _role(model, record, j), np.delete(record.inputs, j, axis=1)
        plain = np.zeros(record.n_samples)
        yield from _Channel(record, part, u, record.inputs[:, j], role, others, plain).faults()
    for j, y in enumerate(model.outputs):
        values, inputs = record.outputs[:, j], record.inputs
        averaged = _averaged(record, j)
        yield from _Channel(record, part, y, values, "sensor", inputs, averaged).faults()


def _averaged(record: Dataset, output: int) -> FloatArray:
    """Samples over which each value of an output is a mean, (n_samples,)."""
    if not record.windows.size:
        return np.zeros(record.n_samples)
    lengths: FloatArray = np.ptp(record.windows[:, output], axis=1) / record.dt
    return lengths


def _role(model: ProcessModel, record: Dataset, place: int) -> Role:
    """What an input is: without calibration, held between samples, a command."""
    if record.input_noise[place] > 0.0:
        return "sensor"
    return "command" if model.inputs[place].hold == "zoh" else "input"


@dataclass(frozen=True)
class _Channel:
    """A channel of a record; role: whether it is a command, a sensor, or an input that is either.

    What a command does is meant. inputs: (n, n_inputs), those that may drive it. averaged: (n,),
    samples over which each is a mean.
    """

    record: Dataset
    part: Part
    signal: Input | Output
    values: FloatArray
    role: Role
    inputs: FloatArray
    averaged: FloatArray

    @property
    def name(self) -> str:
        """Of the signal."""
        return self.signal.name

    def faults(self) -> Iterator[DataFault]:
        """What is wrong with its samples."""
        yield from self._clipping()
        if self.role != "command":
            yield from self._standstill()
        yield from self._outliers()
        if self.role == "sensor":
            yield from self._coarseness()

    def _clipping(self) -> Iterator[DataFault]:
        piles = pile_ups(self.values)
        if not piles:
            return
        share = sum(pile.share for pile in piles)
        levels = " and ".join(self._quantity(pile.level, 4) for pile in piles)
        stretches = sum(pile.stretches for pile in piles)
        statement = (
            f"{self.name} ends at {levels}, where {_percent(share)} of its samples stand in "
            f"{stretches} stretches"
        )
        if self.role == "command" or (self.role == "input" and noise(self.values) == 0.0):
            effect = (
                "right if this is what reached the plant; if only the log was limited, gains and "
                "time constants are wrong"
            )
            yield self._fault("clipped", "note", statement, effect, "log what was applied", share)
            return
        effect = (
            "a sensor at the end of its range; the fit takes what it cut off for a limit of the "
            "plant"
        )
        cure = (
            "record it in a larger range, or write 'robust: true', which counts these samples as "
            "not measured"
        )
        yield self._fault("clipped", "doubt", statement, effect, cure, share)

    def _standstill(self) -> Iterator[DataFault]:
        hang = standstill(self.values, self.inputs, self.averaged)
        if hang is None:
            return
        begin = hang.first * self.record.dt
        end = begin + hang.length * self.record.dt
        statement = (
            f"{self.name} repeats {self._quantity(hang.value, 4)} from {begin:.4g} s to {end:.4g} "
            f"s, {hang.length} samples, then jumps"
        )
        effect = "a channel that hangs looks like a plant that does not move"
        cure = (
            f"leave it out with 'use: 0 s .. {begin:.4g} s', or write 'robust: true', which "
            "counts these samples as not measured"
        )
        yield self._fault("frozen", "doubt", statement, effect, cure, float(hang.at.mean()))

    def _outliers(self) -> Iterator[DataFault]:
        jolts = spikes(self.values, self.inputs, self.averaged)
        if jolts is None or (self.role == "command" and jolts.size < _GROSS * self.values.std()):
            return
        count = int(jolts.at.sum())
        statement = (
            f"{count} sample{'s' * (count != 1)} of {self.name} ({_percent(jolts.share)}) "
            f"{'stand' if count > 1 else 'stands'} off the neighbours, typically by "
            f"{self._quantity(jolts.size)}"
        )
        effect = "squared, they count more than their number, and move every parameter"
        cure = "write 'robust: true', which counts them as not measured"
        yield self._fault("outliers", "doubt", statement, effect, cure, jolts.share)

    def _coarseness(self) -> Iterator[DataFault]:
        steps = coarse_steps(self.values)
        if steps is None:
            return
        statement = (
            f"{self.name} moves over {steps.levels} steps of {self._quantity(steps.step)}, which "
            "are coarser than its noise"
        )
        effect = "errors of half a step are no noise that averages out, and intervals miss them"
        cure = "excite more strongly, or read it in finer steps"
        severity: Severity = "doubt" if steps.levels < _COARSE else "note"
        yield self._fault("coarse", severity, statement, effect, cure, 1.0 / steps.levels)

    def _quantity(self, value: float, digits: int = 3) -> str:
        return f"{value:.{digits}g}" + (
            f" {self.signal.unit}" if self.signal.unit not in {"", "1"} else ""
        )

    def _fault(
        self,
        kind: FaultKind,
        severity: Severity,
        statement: str,
        effect: str,
        cure: str,
        share: float,
    ) -> DataFault:
        where = self.part, (self.record.name,), self.name
        if severity == "doubt" and self.part == "validation":
            effect = _IN_VALIDATION
        moves = severity == "doubt" and self.part == "training"
        settings = ("robust=true",) if "'robust: true'" in cure else ()
        return DataFault(
            kind, severity, *where, statement, effect, cure, share, moves, settings=settings
        )


def _gaps(record: Dataset, part: Part) -> Iterator[DataFault]:
    """Rows that are missing, beside those between which outputs are measured regularly.

    Where inputs were measured meanwhile, only what these samples would tell is.
    """
    rows = np.flatnonzero(np.isfinite(record.outputs).any(axis=1))
    if len(rows) < 3:
        return
    # A first sample alone stands before a run-in, which is left out on purpose.
    distances = np.diff(rows)[1:]
    usual = float(np.median(distances))
    gaps = distances > 1.5 * usual
    ends = rows[1:]
    if not gaps.any() or _inputs_go_on(record, zip(ends[:-1][gaps], ends[1:][gaps], strict=True)):
        return
    lost = distances[gaps] / usual - 1.0
    share = float(lost.sum() / (lost.sum() + len(rows)))
    longest = round(float(lost.max()))
    many = longest >= _LONG or share > 0.05
    part_without = _without_gaps(record, rows, gaps) if many else None
    if not many:
        cure = "a few lost samples do no harm"
    elif part_without is None:
        cure = "record anew"
    else:
        cure = f"fit the part without gaps ('use: {part_without}'), or record anew"
    named = re.fullmatch(r"[\w-]+", record.name) is not None  # as a key can be
    settings = (f"use.{record.name}={part_without}",) if part_without and named else ()
    yield DataFault(
        "gap", "doubt" if many else "note", part, (record.name,), "",
        f"{int(lost.sum())} samples ({_percent(share)}) are missing in {int(gaps.sum())} "
        f"gap{'s' * (int(gaps.sum()) != 1)}, the longest of {longest * usual * record.dt:.3g} s",
        "what its inputs did meanwhile is not known, and counts as if they had gone on",
        cure, share, moves_parameters=many and part == "training", settings=settings,
    )  # fmt: skip


def _inputs_go_on(record: Dataset, gaps: Iterable[tuple[int, int]]) -> bool:
    """Whether inputs were measured between rows, which are neither held there nor straight."""
    for first, last in gaps:
        part = record.inputs[first : last + 1]
        line = np.linspace(part[0], part[-1], len(part))
        bent = np.any(np.abs(part - line) > _STRAIGHT * np.abs(part).max(), axis=0)
        if np.any(bent & np.any(part[:-1] != part[0], axis=0)):
            return True
    return False


def _without_gaps(record: Dataset, rows: IntArray, gaps: BoolArray) -> str | None:
    """The longest stretch without gaps, as ``use`` has it; None where it is too short.

    rows: that are measured. gaps: behind which of them but the first one is, (n_rows - 2,).
    """
    begins = np.append(1, 2 + np.flatnonzero(gaps))
    ends = np.append(1 + np.flatnonzero(gaps), len(rows) - 1)
    longest = int(np.argmax(rows[ends] - rows[begins]))
    first, last = record.dt * rows[begins[longest]], record.dt * rows[ends[longest]]
    if last - first < _ENOUGH * record.dt * record.n_samples:
        return None
    return f"{record.begin + first:.6g} s .. {record.begin + last:.6g} s"


def _copies(training: Sequence[Dataset], validation: Sequence[Dataset]) -> Iterator[DataFault]:
    """Records whose samples stand in another."""
    records = [*training, *validation]
    shares = shared_samples(records) if len(records) > 1 else np.zeros((1, 1))
    for i, record in enumerate(records):
        is_validation = i >= len(training)
        # Of two that are alike the later is the copy; validation is compared with training.
        earlier = shares[i, : len(training) if is_validation else i]
        if not len(earlier) or np.max(earlier) <= _COPIED:
            continue
        share, source = float(np.max(earlier)), records[int(np.argmax(earlier))]
        yield DataFault(
            "copy", "doubt", "validation" if is_validation else "training", (record.name,), "",
            f"{_percent(share)} of its samples stand in {source.name} as well",
            "a model proves itself only on data it has not seen" if is_validation
            else "they count twice, and intervals become too narrow",
            "validate with another log" if is_validation else "leave one of them out",
            share, voids_validation=is_validation,
        )  # fmt: skip


def _stillness(
    model: ProcessModel, training: Sequence[Dataset], validation: Sequence[Dataset]
) -> Iterator[DataFault]:
    """Records that do not move, and outputs that never do."""
    motion = np.array([_deviations(record) for record in training])
    largest = motion.max(axis=0)
    for j, output in enumerate(model.outputs):
        if largest[j] == 0.0 and largest.any():
            yield DataFault(
                "constant", "doubt", "training", tuple(r.name for r in training), output.name,
                f"{output.name} never changes",
                "nothing is learnt from it, and parameters that act on it alone stay open",
                "check its sensor and column, or leave it out with 'outputs'", 1.0,
            )  # fmt: skip
    parts: tuple[tuple[Part, Sequence[Dataset]], ...]
    parts = ("training", training), ("validation", validation)
    for part, records in parts:
        for record in records:
            moves = _deviations(record)
            share = float(np.max(moves[largest > 0.0] / largest[largest > 0.0], initial=0.0))
            buried = [
                bool(m <= 2.0 * noise(y)) for m, y in zip(moves, record.outputs.T, strict=True)
            ]
            if share >= _STILL and not all(buried):
                continue
            how = (
                f"its outputs move {_percent(share)} as far as in training"
                if share < _STILL
                else "no output moves farther than its noise"
            )
            is_validation = part == "validation"
            yield DataFault(
                "still", "doubt", part, (record.name,), "", how,
                "a validation that does not move is none" if is_validation
                else "little but noise is fitted there",
                "validate with a log that moves" if is_validation else "leave it out",
                1.0 - share, voids_validation=is_validation,
            )  # fmt: skip


def _deviations(record: Dataset) -> FloatArray:
    """Standard deviation of each output of a record, 0 where rounding is all that changes."""
    y = record.outputs
    seen = np.isfinite(y)
    count = np.maximum(seen.sum(axis=0), 1)
    centred = np.where(seen, y - np.where(seen, y, 0.0).sum(axis=0) / count, 0.0)
    deviation: FloatArray = np.sqrt(np.sum(centred**2, axis=0) / count)
    peak = np.max(np.where(seen, np.abs(y), 0.0), axis=0)
    return np.where(deviation > 1e-12 * peak, deviation, 0.0)


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.995 else "100 %"
