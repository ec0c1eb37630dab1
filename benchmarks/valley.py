"""What a valley costs: parameters that act only together, beside the same motor determined.

python -m benchmarks.valley [--json] [--samples 1000,8000]

A direct-current motor under random levels, simulated by a Runge-Kutta scheme of its own, identified
with its intervals and judged. Determined: current and speed are measured under a load. Tied: the
speed alone without a load, which shows three combinations of the five parameters; and the same with
two of them given. Seconds of the processors, kernels compiled, which hardly depend on what else the
machine does.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks._common import arguments, report
from benchmarks._stress_cases import DT, MODEL, NOISE, TRUTH, Plant
from sysid import Dataset, ProcessModel
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.judging.examination import verdict_of

_HELD = 25  # samples of a level
_LOAD = 0.02  # N*m
_STAGES = ("fit", "intervals", "verdict")


@dataclass(frozen=True)
class Case:
    """A motor of which some outputs are measured and some parameters given; load in N*m."""

    outputs: tuple[str, ...]
    load: float = 0.0
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def model(self) -> ProcessModel:
        """The motor with these outputs."""
        outputs = tuple(output for output in MODEL.outputs if output.name in self.outputs)
        return replace(MODEL, outputs=outputs)


CASES = {
    "determined": Case(("current", "omega"), _LOAD),
    "tied": Case(("omega",)),
    "tied, two given": Case(("omega",), fixed={name: TRUTH[name] for name in ("R", "K")}),
}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--samples", default="1000,8000", help="lengths of records")
    options = parser.parse_args()
    figures = {
        name: {n: _measured(case, n) for n in map(int, options.samples.split(","))}
        for name, case in CASES.items()
    }
    report({"valley": figures}, options.json, show)


def _measured(case: Case, n_samples: int) -> dict[str, Any]:
    """Processor seconds of fit and intervals, the second time; how many parameters have one."""
    record = _record(case, n_samples)
    for _ in ("compiled", "timed"):
        instants = [time.process_time()]
        estimator = GASSI(case.model, fixed=case.fixed, random_state=0).fit(record)
        instants.append(time.process_time())
        uncertainty = estimator.uncertainty(record)
        instants.append(time.process_time())
        verdict_of(estimator, [record], uncertainty=uncertainty)
        instants.append(time.process_time())
    names = {row.name for row in uncertainty.determined()} & set(MODEL.parameter_names)
    seconds = dict(zip(_STAGES, np.diff(instants).tolist(), strict=True))
    return {**seconds, "determined": len(names), "free": len(estimator.space_.index)}


def _record(case: Case, n_samples: int) -> Dataset:
    rng = np.random.default_rng(n_samples)
    inputs = np.stack([_levels(rng, n_samples, 6.0), _levels(rng, n_samples, case.load)], axis=1)
    noise = NOISE * rng.standard_normal((n_samples, len(NOISE)))
    _, outputs = Plant().run(inputs, noise, TRUTH)
    measured = [MODEL.output_names.index(name) for name in case.outputs]
    return Dataset(inputs, outputs[:, measured], DT)


def _levels(rng: np.random.Generator, n_samples: int, reach: float) -> FloatArray:
    return np.repeat(rng.uniform(-reach, reach, n_samples // _HELD + 1), _HELD)[:n_samples]


def show(figures: dict[str, Any]) -> None:
    print(f"{'seconds of CPU':20}{'samples':>8}" + "".join(f"{stage:>11}" for stage in _STAGES))
    for name, by_length in figures["valley"].items():
        for n_samples, row in by_length.items():
            seconds = "".join(f"{row[stage]:11.2f}" for stage in _STAGES)
            counted = f"{row['determined']} of {row['free']} determined"
            print(f"{name:20}{n_samples:8}{seconds}  {counted}")


if __name__ == "__main__":
    main()
