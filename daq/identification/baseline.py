"""A linear model beside an identification: what physics adds to knowing none."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from daq.identification.records import LoggedRecord
from sysid import Dataset, ModelError
from sysid.arrays import FloatArray
from sysid.linear import ARMAX, tuned
from sysid.problem.metrics import Metrics, evaluate
from sysid.problem.model import ProcessModel

# Orders tried, few enough for a second: each output's own search is small.
_NA, _NB, _NC = range(1, 5), range(1, 4), (0, 2)
# Samples times outputs times signals beyond which even these take long.
_LARGEST = 80_000


@dataclass(frozen=True)
class Baseline:
    """A fitted linear model: its orders, errors on every log, and free runs over some.

    runs: of each validation log, (n_samples, n_outputs).
    """

    name: str
    orders: dict[str, Any]
    training: Sequence[Metrics]
    validation: Sequence[Metrics]
    runs: Sequence[FloatArray]


def baseline_of(
    model: ProcessModel, training: Sequence[LoggedRecord], validation: Sequence[LoggedRecord]
) -> Baseline | str:
    """A linear model of the same logs, or why there is none."""
    try:
        return armax(model, [log.dataset for log in training], [log.dataset for log in validation])
    except ModelError as error:
        return str(error)


def armax(
    model: ProcessModel, training: Sequence[Dataset], validation: Sequence[Dataset]
) -> Baseline:
    """ARMAX with orders chosen on the ends of the training records.

    Raises ModelError where there is none: records too short, too long for the time that a report
    may take, of several sample times, or free runs that grow without bounds.
    """
    q, m = len(model.outputs), len(model.inputs)
    rows = sum(record.n_samples for record in training)
    if not m:
        raise ModelError("the model has no inputs")
    if rows * q * (q + m) > _LARGEST:
        raise ModelError(
            f"choosing its orders on {rows} samples takes longer than a report may; "
            "rig identify --armax does it"
        )
    # An input held from its sample on acts first on the next row; an interpolated one at once.
    first = [[int(signal.hold == "zoh") for signal in model.inputs]] * q
    selection = tuned(ARMAX(stable=True), list(training), na=_NA, nb=_NB, nc=_NC, nk=[first])
    runs = {id(record): selection.model.predict(record) for record in (*training, *validation)}

    def metrics(records: Sequence[Dataset]) -> list[Metrics]:
        return [evaluate(record.outputs, runs[id(record)]) for record in records]

    return Baseline(
        "ARMAX",
        {name: order for name, order in selection.best.orders.items() if name != "nk"},
        metrics(training),
        metrics(validation),
        [runs[id(record)] for record in validation],
    )
