"""Do the answers depend on the seed of the search?

python -m benchmarks.searches [--json] [--logs 4] [--searches 6] [--experiment prbs.yaml]
                              [--jobs N] [--dask ADDRESS]

Logs of a shipped experiment, a seed of the simulated rig's noise each, are identified again and
again with another seed of the search. Asked of each parameter and combination: is the same said of
it (an interval of both ends, of one, only together, two answers) as by most searches of that log,
and how far are the ends of its interval from theirs, in parts of the interval. The bar: the same
is said by every seed.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, simulated_logs, spread, spreading
from daq.identification.rows import LABELS
from sim_rig.actuator import actuator
from sysid import GASSI
from sysid.uncertainty.estimate import Estimate

_Ends = tuple[float | None, float | None]


@dataclass(frozen=True)
class _Answers:
    """What a search of a log says of each quantity, and the ends of its interval."""

    log: int
    search: int
    said: Mapping[str, str]
    ends: Mapping[str, _Ends]


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--logs", type=int, default=4, help="seeds of noise")
    parser.add_argument("--searches", type=int, default=6, help="of each log")
    parser.add_argument("--experiment", default="prbs.yaml", help="a shipped one")
    spreading(parser)
    options = parser.parse_args()
    pairs = itertools.product(range(options.logs), range(options.searches))
    threads = None if options.jobs == 1 and not options.dask else 1
    search = partial(_searched, options.experiment, threads)
    answers = spread(search, pairs, options, lambda a: f"{len(a.said)} quantities")
    logs = [[answer for answer in answers if answer.log == log] for log in range(options.logs)]
    report({"searches": [_compared(of_log) for of_log in logs if of_log]}, options.json, show)


def _searched(experiment: str, threads: int | None, pair: tuple[int, int]) -> _Answers:
    log, search = pair
    model = actuator()
    record, _ = simulated_logs(model, log, experiment)
    uncertainty = GASSI(model, random_state=search, threads=threads).fit(record).uncertainty(record)
    estimates = [*uncertainty.parameters, *uncertainty.determined()]
    return _Answers(
        log,
        search,
        {estimate.name: _said(estimate) for estimate in estimates},
        {estimate.name: (estimate.low, estimate.high) for estimate in estimates},
    )


def _said(estimate: Estimate) -> str:
    if estimate.why:
        return LABELS[estimate.why]
    return "one end" if None in (estimate.low, estimate.high) else "an interval"


def _compared(answers: Sequence[_Answers]) -> dict[str, Any]:
    """Of one log: how many searches say what most do, and the largest distance of an end."""
    names = dict.fromkeys(name for answer in answers for name in answer.said)
    unlike, apart = {}, {}
    for name in names:
        said = Counter(answer.said.get(name, "nothing") for answer in answers)
        if len(said) > 1:
            unlike[name] = dict(said.most_common())
        ends = [answer.ends[name] for answer in answers if name in answer.ends]
        whole = np.array([pair for pair in ends if None not in pair], dtype=np.float64)
        if len(whole) > 1:
            apart[name] = float(np.max(np.ptp(whole, axis=0) / np.median(np.diff(whole, axis=1))))
    most = Counter(frozenset(answer.said.items()) for answer in answers).most_common(1)[0][1]
    return {
        "log": answers[0].log, "searches": len(answers), "alike": most, "unlike": unlike,
        "ends_apart": dict(sorted(apart.items(), key=lambda item: -item[1])),
    }  # fmt: skip


def show(figures: dict[str, Any]) -> None:
    for log in figures["searches"]:
        print(f"\nlog {log['log']}: {log['alike']} of {log['searches']} searches say the same")
        for name, said in log["unlike"].items():
            print(f"  {name}: " + ", ".join(f"{what} {count}" for what, count in said.items()))
        for name, apart in itertools.islice(log["ends_apart"].items(), 3):
            print(f"  {name}: ends within {100.0 * apart:.0f} % of the interval")


if __name__ == "__main__":
    main()
