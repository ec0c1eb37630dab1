"""A linear model beside an identification: what physics adds to knowing none."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from daq.identification.records import LoggedRecord
from sysid import ModelError
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
    """ARMAX with orders chosen on the ends of the training logs, or why there is none.

    There is none for logs too short, too long for the time that a report may take, of several
    sample times, or with free runs that grow without bounds.
    """
    q, m = len(model.outputs), len(model.inputs)
    groups = [[log.dataset for log in logs] for logs in (training, validation)]
    rows = sum(record.n_samples for record in groups[0])
    if not m:
        return "the model has no inputs"
    if rows * q * (q + m) > _LARGEST:
        return (
            f"choosing its orders on {rows} samples takes longer than a report may; "
            "rig identify --armax does it"
        )
    # An input held from its sample on acts first on the next row; an interpolated one at once.
    first = [[int(signal.hold == "zoh") for signal in model.inputs]] * q
    try:
        selection = tuned(ARMAX(stable=True), groups[0], na=_NA, nb=_NB, nc=_NC, nk=[first])
        runs = [[selection.model.predict(record) for record in records] for records in groups]
    except ModelError as error:
        return str(error)
    trained, validated = [
        [evaluate(record.outputs, run) for record, run in zip(records, simulated, strict=True)]
        for records, simulated in zip(groups, runs, strict=True)
    ]
    orders = {name: order for name, order in selection.best.orders.items() if name != "nk"}
    return Baseline("ARMAX", orders, trained, validated, runs[1])
