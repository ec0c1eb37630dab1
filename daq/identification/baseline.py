"""Linear models beside an identification: what physics adds to knowing none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from daq.identification.records import LoggedRecord
from sysid import Dataset, ModelError
from sysid.arrays import FloatArray
from sysid.linear import OE, tuned
from sysid.problem.metrics import Metrics, evaluate
from sysid.problem.model import ProcessModel
from sysid.problem.regressors import with_regressors

# Orders tried, few enough for a second; and those of the fit in hindsight.
_NF, _NB = range(1, 4), range(1, 3)
_RICHEST = {"nf": 4, "nb": 2}
# Samples times outputs times signals beyond which even these take long.
_LARGEST = 80_000


@dataclass(frozen=True)
class Baseline:
    """A fitted linear model: its orders, errors on every log, and free runs over some.

    training: empty of a model that was fitted to the validation data. runs: of each validation
    log, (n_samples, n_outputs). inputs: what it was given beside the model's inputs.
    """

    name: str
    orders: dict[str, Any]
    training: Sequence[Metrics]
    validation: Sequence[Metrics]
    runs: Sequence[FloatArray]
    inputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class LinearData:
    """What linear models are fitted to: records for training and for validation.

    extended: the same with the model's ``regressors`` as inputs behind its own; regressors: their
    names. lacking: why there can be no linear model, if there can be none.
    """

    records: Sequence[Sequence[Dataset]]
    extended: Sequence[Sequence[Dataset]] = ()
    regressors: tuple[str, ...] = ()
    lacking: str = ""

    @classmethod
    def of(
        cls,
        model: ProcessModel,
        training: Sequence[LoggedRecord],
        validation: Sequence[LoggedRecord],
    ) -> Self:
        """Of a model's logs."""
        q, m = len(model.outputs), len(model.inputs)
        records = [[log.dataset for log in logs] for logs in (training, validation)]
        rows = sum(record.n_samples for record in records[0])
        if not m:
            return cls(records, lacking="the model has no inputs")
        if rows * q * (q + m) > _LARGEST:
            why = (
                f"choosing its orders on {rows} samples takes longer than a report may; "
                "rig identify --oe does it"
            )
            return cls(records, lacking=why)
        try:
            return cls(records, *_extended(model, records))
        except ModelError as error:
            return cls(records, lacking=str(error))


def baselines_of(data: LinearData) -> list[Baseline] | str:
    """Output-error models, the best linear free runs there are; or why there are none.

    First one with orders chosen on the ends of the training logs; then one with the model's
    ``regressors`` as further inputs, if it has any; then one that is fitted to the validation logs
    themselves: what other orders or training data would not make a linear model exceed by much.
    There are none for logs too short, too long for the time that a report may take, or of several
    sample times.
    """
    return joined(of_inputs(data), of_regressors(data))


def joined(plain: list[Baseline] | str, extended: list[Baseline] | str) -> list[Baseline] | str:
    """Those of ``of_inputs`` and of ``of_regressors`` in the order of ``baselines_of``."""
    if isinstance(plain, str):
        return plain
    return extended if isinstance(extended, str) else [*plain[:1], *extended, *plain[1:]]


def of_inputs(data: LinearData) -> list[Baseline] | str:
    """The baselines that have the model's inputs, or why there are none."""
    if data.lacking:
        return data.lacking
    try:
        chosen = _tuned("OE", *data.records)
        validated = data.records[1]
        return [chosen, _in_hindsight(chosen, validated)] if validated else [chosen]
    except ModelError as error:
        return str(error)


def of_regressors(data: LinearData) -> list[Baseline] | str:
    """The baseline that has the model's regressors as well, if there are any."""
    if not data.regressors:
        return []
    try:
        return [replace(_tuned("OE, more inputs", *data.extended), inputs=data.regressors)]
    except ModelError as error:
        return str(error)


def refitted(
    document: Mapping[str, Any],
    training: Sequence[LoggedRecord],
    validation: Sequence[LoggedRecord],
) -> Baseline:
    """A baseline once more, of the name and the orders that a report's document has of it."""
    name, orders = document["name"], document["orders"]
    records = [[log.dataset for log in logs] for logs in (training, validation)]
    return _judged(name, orders, OE(**orders).fit(records[0]), *records)


def _tuned(name: str, training: Sequence[Dataset], validation: Sequence[Dataset]) -> Baseline:
    selection = tuned(OE(), training, nf=_NF, nb=_NB)
    return _judged(name, selection.best.orders, selection.model, training, validation)


def _in_hindsight(tuned: Baseline, validation: Sequence[Dataset]) -> Baseline:
    """Fitted to what it is judged on, to which no more of the other's choices matter."""
    orders = {**_RICHEST, "nk": tuned.orders["nk"]}
    fitted = OE(**orders).fit(list(validation))
    return _judged("OE, in hindsight", orders, fitted, (), validation)


def _judged(
    name: str,
    orders: dict[str, Any],
    model: OE,
    training: Sequence[Dataset],
    validation: Sequence[Dataset],
) -> Baseline:
    runs = [[model.predict(record) for record in records] for records in (training, validation)]
    trained, validated = [
        [evaluate(record.outputs, run) for record, run in zip(records, simulated, strict=True)]
        for records, simulated in zip((training, validation), runs, strict=True)
    ]
    return Baseline(name, orders, trained, validated, runs[1])


def _extended(
    model: ProcessModel, parts: Sequence[Sequence[Dataset]]
) -> tuple[list[list[Dataset]], tuple[str, ...]]:
    """Records with the model's regressors as inputs, and their names."""
    pairs = [[with_regressors(model, record) for record in records] for records in parts]
    return [[record for record, _ in part] for part in pairs], pairs[0][0][1]
