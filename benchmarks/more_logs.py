"""More logs never determine less: what one log determines, more of them determine, and better.

python -m benchmarks.more_logs [--json] [--seeds 20] [--logs 8] [--data FOLDER]

A motor of ``benchmarks.stress`` is identified from its first log, its first two, and so on; then a
magnetorheological damper from its measured logs (see ``benchmarks.damper``), every second one
added. Printed is how many quantities have an interval on both sides, and which have lost theirs. An
interval may widen where further logs disagree; the share of those that do is printed as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks._common import arguments, report
from benchmarks._stress_cases import cases
from benchmarks.damper import ROOT, load
from sysid import GASSI, Dataset
from sysid.problem.model import ProcessModel


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=20, help="of the motor's logs and searches")
    parser.add_argument("--logs", type=int, default=8, help="of the motor")
    parser.add_argument(
        "--data",
        type=Path,
        default=ROOT.parent / "shared" / "data" / "mr_damper",
        help="folder of the damper's logs; default %(default)s",
    )
    options = parser.parse_args()
    (case,) = (case for case in cases() if case.name == "three logs")
    case = replace(case, logs=options.logs)
    rows = []
    for seed in range(options.seeds):
        rows.append(_row(f"motor, seed {seed}", case.model, case.records(seed)[0], seed))
    if options.data.is_dir():
        model, logs = load(options.data)
        records = list(map(_thinned, logs))
        rows.append(_row("damper", model, records, 0, step=3))
    report({"rows": rows}, options.json, show)


def _thinned(record: Dataset) -> Dataset:
    """About a thousand samples of a log."""
    every = max(record.n_samples // 1000, 1)
    return replace(
        record,
        inputs=record.inputs[::every],
        outputs=record.outputs[::every],
        dt=every * record.dt,
    )


def _row(
    name: str, model: ProcessModel, records: Sequence[Dataset], seed: int, step: int = 1
) -> dict[str, Any]:
    """What ever more of the records determine."""
    counts = [*range(1, len(records), step), len(records)]
    known: list[dict[str, float]] = []
    for count in counts:
        some = list(records[:count])
        estimator = GASSI(model, population=60, generations=12, random_state=seed).fit(some)
        quantities = estimator.uncertainty(some).determined()
        known.append({q.name: q.high - q.low for q in quantities if None not in (q.low, q.high)})
    lost = {
        f"{more} logs": gone
        for (fewer, many), more in zip(pairwise(known), counts[1:], strict=True)
        if (gone := sorted(set(fewer) - set(many)))
    }
    pairs = [(fewer[n], many[n]) for fewer, many in pairwise(known) for n in fewer if n in many]
    return {
        "name": name,
        "logs": counts,
        "determined": [len(quantities) for quantities in known],
        "lost": lost,
        "widened": sum(b > a for a, b in pairs) / max(len(pairs), 1),
    }


def show(figures: dict[str, Any]) -> None:
    for row in figures["rows"]:
        counts = " ".join(map(str, row["determined"]))
        lost = "; ".join(f"{more}: {', '.join(names)}" for more, names in row["lost"].items())
        print(
            f"{row['name']:18}{counts}  wider next {100.0 * row['widened']:.0f} %  "
            f"lost: {lost or 'none'}"
        )
    sound = sum(not row["lost"] for row in figures["rows"])
    print(f"{sound} of {len(figures['rows'])} never determine less")


if __name__ == "__main__":
    main()
