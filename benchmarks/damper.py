"""One parameter set for 18 measured logs of a magnetorheological damper, and how far it carries.

python -m benchmarks.damper [--json] [--data FOLDER] [--population 150] [--generations 30]

The model is that of examples/mr_damper. Beside the mean fit over all logs it prints what the
same procedure predicts of logs it has not seen: each log left out in turn, then each current and
each motion (amplitude and frequency). A refit knows nothing of what was left out: its search
starts anew from the model's wide ranges, with a seed of its own, on the remaining logs alone.

The intervals from every second log and from the others are printed beside each other: of a model
that is right they would overlap.

Searches run on thinned logs of about 1000 samples; parameters are then refined, and fits
counted, on all samples.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, timed
from daq.identification import records as datasets
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from sysid import GASSI, BatchSimulator, Dataset, SearchSpace, evaluate, free_run
from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.problem.model import ProcessModel
from sysid.uncertainty import Estimate

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "examples" / "mr_damper" / "identification.yaml"
SEARCH_SAMPLES = 1000  # of a log in the search
AUTHORS_FIT = 86.4  # mean fit [%] of the original authors' 12-parameter model on these logs


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument(
        "--data",
        type=Path,
        default=ROOT.parent / "shared" / "data" / "mr_damper",
        help="folder of the logs; default %(default)s",
    )
    parser.add_argument("--population", type=int, default=150, help="chromosomes per generation")
    parser.add_argument("--generations", type=int, default=30, help="generations of a search")
    parser.add_argument("--seed", type=int, default=0, help="of the search on all logs")
    options = parser.parse_args()
    if not options.data.is_dir():
        print(f"skipped: the logs are not in {options.data}; name their folder with --data")
        return
    model, logs = load(options.data)
    fitter = Fitter(model, options.population, options.generations)
    report(figures(fitter, logs, options.seed), options.json, show)


def load(folder: Path) -> tuple[ProcessModel, list[Dataset]]:
    """The example's model, and a folder's logs read through the example's columns."""
    prepared = problem_of(SettingsRequest(str(CONFIG)))
    paths = datasets.expand(folder)
    model = prepared.model
    return model, [datasets.load(path, model, prepared.mapping).dataset for path in paths]


class Fitter:
    """From logs to parameters: search on thinned logs, refinement on all samples.

    All logs count alike, whatever their length and largest force.
    """

    def __init__(self, model: ProcessModel, population: int, generations: int) -> None:
        self.model = model
        self.population = population
        self.generations = generations
        self._simulator = BatchSimulator(model)

    def fit(self, logs: list[Dataset], seed: int) -> FloatArray:
        """Parameters for some logs, (n_parameters,)."""
        search = GASSI(
            self.model,
            population=self.population,
            generations=self.generations,
            per_log=True,
            balance="logs",
            random_state=seed,
        ).fit([thinned(log) for log in logs])
        space = SearchSpace.of(self.model)
        objective = Objective(self._simulator, space, logs, per_log=True, balance="logs")
        return space.full(refine(objective, search.chromosome_).chromosome)

    def fits(self, vector: FloatArray, logs: list[Dataset]) -> list[float]:
        """Fit [%] of each log's force, all samples, free run."""
        simulated = [free_run(self._simulator, vector, log) for log in logs]
        return [
            float(evaluate(log.outputs, y).fit[0]) for log, y in zip(logs, simulated, strict=True)
        ]


def thinned(log: Dataset) -> Dataset:
    """Every n-th sample of a log; the motion between them is smooth."""
    every = max(1, log.n_samples // SEARCH_SAMPLES)
    return Dataset(log.inputs[::every], log.outputs[::every], every * log.dt, log.name)


def figures(fitter: Fitter, logs: list[Dataset], seed: int) -> dict[str, Any]:
    """Fit on all logs, and of logs left out."""
    seconds, vector = timed(lambda: fitter.fit(logs, seed))
    fits = fitter.fits(vector, logs)
    names = [log.name for log in logs]
    groups = {
        "log": names,
        "current": [re.split("_", name)[-1] for name in names],
        "motion": [name.rsplit("_", 1)[0] for name in names],
    }
    return {
        "logs": len(logs),
        "samples": sum(log.n_samples for log in logs),
        "parameters": dict(zip(fitter.model.parameter_names, map(float, vector), strict=True)),
        "seconds": seconds,
        "mean_fit": float(np.mean(fits)),
        "fits": dict(zip(names, fits, strict=True)),
        "authors_mean_fit": AUTHORS_FIT,
        "halves": halves(fitter, logs, seed),
        "left_out": {kind: left_out(fitter, logs, keys, seed) for kind, keys in groups.items()},
    }


def halves(fitter: Fitter, logs: list[Dataset], seed: int) -> dict[str, Any]:
    """Intervals of each parameter from every second log and from the others, None for no end."""
    intervals = []
    for half in (logs[::2], logs[1::2]):
        estimator = GASSI(
            fitter.model,
            population=fitter.population,
            generations=fitter.generations,
            per_log=True,
            balance="logs",
            random_state=seed,
        ).fit(half)
        intervals.append(estimator.uncertainty(half).parameters)
    pairs = {first.name: (first, second) for first, second in zip(*intervals, strict=True)}
    return {
        "overlapping": sum(_overlap(*pair) for pair in pairs.values()),
        "intervals": {name: [[e.low, e.high] for e in pair] for name, pair in pairs.items()},
    }


def _overlap(first: Estimate, second: Estimate) -> bool:
    ends = [(e.low if e.low is not None else -np.inf, e.high if e.high is not None else np.inf)
            for e in (first, second)]  # fmt: skip
    return max(low for low, _ in ends) <= min(high for _, high in ends)


def left_out(fitter: Fitter, logs: list[Dataset], keys: list[str], seed: int) -> dict[str, Any]:
    """Logs of each key predicted with parameters of all the others."""
    groups: dict[str, list[Dataset]] = defaultdict(list)
    for key, log in zip(keys, logs, strict=True):
        groups[key].append(log)
    fits: dict[str, float] = {}
    for number, (key, hidden) in enumerate(groups.items(), seed + 1):
        seen = [log for log, other in zip(logs, keys, strict=True) if other != key]
        vector = fitter.fit(seen, number)
        found = fitter.fits(vector, hidden)
        fits |= {log.name: fit for log, fit in zip(hidden, found, strict=True)}
    return {"mean_fit": float(np.mean(list(fits.values()))), "fits": fits, "refits": len(groups)}


def show(figures: dict[str, Any]) -> None:
    print(f"\n{figures['logs']} logs, {figures['samples']} samples, one parameter set:")
    for name, value in figures["parameters"].items():
        print(f"  {name:<14} {value:.4g}")
    print(
        f"mean fit {figures['mean_fit']:.1f} % ({figures['seconds']:.0f} s); "
        f"the original authors' model {figures['authors_mean_fit']} %"
    )
    intervals = figures["halves"]["intervals"]
    print(f"\n95 % intervals from halves of the logs: {figures['halves']['overlapping']} of "
          f"{len(intervals)} overlap")  # fmt: skip
    for name, pair in intervals.items():
        written = (" .. ".join("-" if end is None else f"{end:.4g}" for end in i) for i in pair)
        print(f"  {name:<14} " + "   ".join(f"{text:<24}" for text in written))
    left = figures["left_out"]
    print(f"\n{'fit [%]':<26} {'all logs':>8}" + "".join(f"{f'no such {k}':>16}" for k in left))
    for name, fit in figures["fits"].items():
        print(f"{name:<26} {fit:8.1f}" + "".join(f"{e['fits'][name]:16.1f}" for e in left.values()))
    means = "".join(f"{entry['mean_fit']:16.1f}" for entry in left.values())
    print(f"{'mean':<26} {figures['mean_fit']:8.1f}{means}")


if __name__ == "__main__":
    main()
