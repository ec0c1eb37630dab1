"""What `rig characterise` tells of hidden rigs, beside 8 runs of the shipped PRBS.

python -m benchmarks.characterise [--json] [--rigs 3] [--first 0] [--time 10]
                                 [--model actuator:limits=true] [--keep FOLDER]
                                 [--set sample_rate=1600]

Each rig is the simulated one with the model's nominal values, each times a factor of 0.6 to 1.6
drawn anew. It is characterised from the model's ranges within 10 s of logged time; the same rig
then makes 8 runs of the shipped PRBS, 10 s, with seeds of their own, which are identified together.
Figures: geometric mean of the ratio of the intervals' widths (of a quantity that the PRBS does not
bound the ratio counts none), the widest interval, how many hold the truth, and achieved over
predicted deviations; of each round the same on standard error as it ends, with the runs that
limits stopped and seconds of processor time. --set: as of `rig characterise`; the shipped PRBS has
800 Hz all the same. --keep: where the characterisations stay, one folder a rig; one that is there
is gone on with, and so is one that a limit has stopped.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks._common import arguments, prbs_logs, report
from daq.characterise import characterise
from daq.characterise.rounds import Interval, Round, rounds_of
from daq.errors import InterlockError
from daq.identification.fit import fit
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.lookup.models import DRIVEN_MODEL, find_model
from daq.lookup.shipped import find_file
from daq.progress import Started
from sim_rig.actuator import actuator
from sysid import identifiability
from sysid.experiments.quantities import determined
from sysid.problem.space import SearchSpace

RUNS = 8
FACTORS = 0.6, 1.6
SEEDS = 1000  # between those of one rig's runs and the next


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--rigs", type=int, default=3, help="hidden parameters drawn")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--time", type=float, default=10.0, help="logged time [s]")
    parser.add_argument("--model", default=DRIVEN_MODEL, help="that is identified")
    parser.add_argument("--set", action="append", default=[], help="key=value of the designs")
    parser.add_argument("--keep", type=Path, help="folder in which the characterisations stay")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.rigs)
    with tempfile.TemporaryDirectory() as temporary:
        place = options.keep or Path(temporary)
        rigs = [
            hidden_rig(number, options.time, options.model, place / f"rig-{number}", options.set)
            for number in numbers
        ]
    report({"rigs": rigs}, options.json, show)


def hidden_rig(
    number: int, seconds: float, name: str, folder: Path, settings: Sequence[str] = ()
) -> dict[str, Any]:
    """Figures of one rig, by the name of the model that is identified."""
    values = hidden_values(number, name)
    begin = time.perf_counter()
    designed, rounds = _characterised(folder, number, seconds, name, settings)
    spent = time.perf_counter() - begin
    shipped = _shipped(folder, folder / "rig.yaml", designed.rounds[-1], number, name)
    bounded = [i for i in designed.intervals if i.width is not None]
    pairs = [(i.width, shipped[i.name].width) for i in bounded if shipped[i.name].width]
    ratios = [prbs / width for width, prbs in pairs if width and prbs]
    return {
        "rig": number,
        "seconds": spent,
        "logged": designed.seconds,
        "rounds": rounds,
        "quantities": {
            i.name: {
                "designed": i.width,
                "expected": i.expected,
                "prbs": shipped[i.name].width,
                "value": i.value,
                "truth": values[i.name],
            }
            for i in designed.intervals
        },
        "narrower": _mean(ratios),
        "unbounded_by_prbs": sum(i.width is None for i in shipped.values()),
        "unbounded": len(designed.intervals) - len(bounded),
        "covered": _share_covered(designed.intervals, values),
        "covered_by_prbs": _share_covered(shipped.values(), values),
    }


@dataclass
class _Rounds:
    """Figures of each round as it ends, told while the next begins."""

    root: Path
    values: Mapping[str, float]
    figures: list[dict[str, Any]] = field(default_factory=list)
    begin: float = field(default_factory=time.process_time)

    def watch(self, event: object) -> None:
        if isinstance(event, Started):
            self.tell(rounds_of(self.root))

    def tell(self, done: Sequence[Round]) -> None:
        for each in done[len(self.figures) :]:
            now = time.process_time()
            self.figures.append(round_figures(each, self.values) | {"cpu": now - self.begin})
            self.begin = now
            print(self.figures[-1], file=sys.stderr, flush=True)


def _characterised(
    folder: Path, number: int, seconds: float, name: str, settings: Sequence[str]
) -> tuple[characterise.Characterisation, list[dict[str, Any]]]:
    """A rig's characterisation, gone on with where it has begun, and figures of its rounds."""
    root = folder / "c"
    told = _Rounds(root, hidden_values(number, name))
    folder.mkdir(parents=True, exist_ok=True)
    rig = _rig_file(folder, number, hidden_parameters(number))
    while True:
        try:
            if root.exists():
                designed = characterise.resume(root, watch=told.watch)
            else:
                designed = characterise.characterise(
                    rig, seconds, None, root, model=name, settings=settings, watch=told.watch
                )
        except InterlockError as error:  # as a person would who reads what stopped it
            print(error, file=sys.stderr, flush=True)
            continue
        told.tell(designed.rounds)
        return designed, told.figures


def round_figures(done: Round, values: Mapping[str, float]) -> dict[str, Any]:
    """What the runs until then have told, beside what the round's design predicted."""
    intervals = done.intervals()
    bounded = [i for i in intervals if i.width and i.expected]
    ratios = [i.width / i.expected for i in bounded if i.width and i.expected]
    return {
        "round": done.number,
        "runs": len(done.experiments),
        "stopped": sum(done.stops(experiment) for experiment in done.experiments),
        "bounded": f"{len(bounded)} of {len(intervals)}",
        "geometric mean": _mean([i.width for i in bounded if i.width]),
        "widest": max((i.width, i.name) for i in bounded if i.width) if bounded else None,
        "achieved over predicted": _mean(ratios),
        "covered": _share_covered(intervals, values),
    }


def _mean(ratios: Sequence[float]) -> float | None:
    """Geometric mean; None of none."""
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else None


def hidden_values(number: int, name: str) -> dict[str, float]:
    """What experiments can tell of a rig, by the name of the model that is identified."""
    model = find_model(name)
    nominal = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    structure, space = identifiability(model, sensors=False), SearchSpace.of(model)
    truth = nominal | hidden_parameters(number)
    return {q.text: q.value(truth) for q in determined(structure, space)}


def hidden_parameters(number: int) -> dict[str, float]:
    """Parameters of a rig: the first that are drawn which the model's constraints allow."""
    space, rng = SearchSpace.of(actuator()), np.random.default_rng(number)
    nominal = np.array([parameter.nominal for parameter in space.parameters])
    while True:
        values = nominal * rng.uniform(*FACTORS, len(nominal))
        if space.feasible(values):
            return dict(zip(space.names, values.tolist(), strict=True))


def _share_covered(intervals: Iterable[Interval], truth: Mapping[str, float]) -> float:
    """Share of the intervals with two ends that hold the truth."""
    held = [
        i.low <= truth[i.name] <= i.high
        for i in intervals
        if i.low is not None and i.high is not None
    ]
    return sum(held) / max(len(held), 1)


def _rig_file(folder: Path, number: int, truth: dict[str, float]) -> Path:
    content = yaml.safe_load(find_file("backend", "simulated.yaml").read_text(encoding="utf-8"))
    content["options"]["seed"] = number
    content["options"]["plant"]["parameters"] = {name: float(v) for name, v in truth.items()}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def _shipped(folder: Path, rig: Path, last: Round, number: int, model: str) -> dict[str, Interval]:
    """Intervals of the same quantities from runs of the shipped PRBS."""
    # The same seed would be the same noise in each.
    logs = prbs_logs(folder, RUNS, rig, SEEDS * (number + 1))
    identification = Round(folder / "shipped", 1)
    identification.folder.mkdir(parents=True)
    (identification.folder / "design.json").write_bytes((last.folder / "design.json").read_bytes())
    problem = problem_of(SettingsRequest(options={"model": model}))
    fit(problem, logs, [], identification.identification)
    return {interval.name: interval for interval in identification.intervals()}


def show(figures: dict[str, Any]) -> None:
    for rig in figures["rigs"]:
        print(f"\nRig {rig['rig']}: {rig['logged']:g} s logged, {rig['seconds']:.0f} s spent")
        for name, q in rig["quantities"].items():
            widths = (q[key] for key in ("designed", "expected", "prbs"))
            shown = "  ".join(f"{'-':>9}" if w is None else f"{100 * w:7.3g} %" for w in widths)
            print(f"  {name:20} {shown}   off {100 * (q['value'] / q['truth'] - 1):+.2g} %")
        print(f"  narrower by {rig['narrower']}, covered {rig['covered']:.2f}")
        print(f"  unbounded: {rig['unbounded']}, by the PRBS {rig['unbounded_by_prbs']}")


if __name__ == "__main__":
    main()
