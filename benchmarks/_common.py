"""What the benchmarks share: arguments, the machine's name, a log of the simulated rig."""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import yaml

from daq import record
from daq.config.rig import RigConfig
from daq.identification import records as datasets
from daq.identification.campaign import Workers
from daq.logs.capture import LOG_NAME
from daq.lookup.experiments import load_experiment
from daq.lookup.rigs import load_rig
from daq.lookup.shipped import find_file
from daq.provenance import software_versions
from daq.run.runner import run_experiment
from sim_rig.backend import SimulatedDevice
from sysid import Dataset, StudyResult, study
from sysid.problem.model import ProcessModel
from sysid.threads import available_cores

_SEEDS = 1000  # between those of one PRBS and the next


def arguments(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", action="store_true", help="one JSON document")
    return parser


def spreading(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where a study is computed."""
    parser.add_argument("--jobs", type=int, default=1, help="processes here, -1 for all cores")
    parser.add_argument("--dask", metavar="ADDRESS", help="a dask cluster's scheduler")


def spread(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    options: argparse.Namespace,
    told: Callable[[Any], str],
) -> list[Any]:
    """The function of every item, in their order, computed where the options say.

    told: a line for each value as it comes. An item that fails is told, and left out; Ctrl-C keeps
    what is there.
    """

    def tell(result: StudyResult) -> None:
        line = result.problem or told(result.value)
        print(f"{result.item}: {line} ({result.seconds:.0f} s)", file=sys.stderr, flush=True)

    with Workers(options.jobs, options.dask).ready() as jobs:
        return study(function, items, n_jobs=jobs, on_result=tell).values


def machine() -> dict[str, Any]:
    """Processor, cores and versions that the figures belong to."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(encoding="utf-8").splitlines()
        cpu = next((s.split(":", 1)[1].strip() for s in lines if s.startswith("model name")), cpu)
    return {"cpu": cpu, "cores": available_cores(), **software_versions()}


def report(figures: dict[str, Any], as_json: bool, show: Callable[[dict[str, Any]], None]) -> None:
    """Print the figures with the machine they were measured on."""
    figures = {"machine": machine(), **figures}
    if as_json:
        json.dump(figures, sys.stdout, indent=2)
        print()
        return
    about = figures["machine"]
    print(f"{about['cpu']}, {about['cores']} cores, Python {about['python']}")
    show(figures)


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds a call takes, and what it returns."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def rig_of(experiment: str) -> tuple[RigConfig, SimulatedDevice]:
    """The simulated rig that a shipped experiment is for."""
    name = load_experiment(experiment).experiment.rig or "simulated.yaml"
    rig, device = load_rig(name)
    assert isinstance(device, SimulatedDevice)
    return rig, device


def simulated_logs(
    model: ProcessModel, seed: int | None = None, experiment: str = "prbs.yaml", **plant: Any
) -> tuple[Dataset, Dataset]:
    """Training and validation record of a shipped experiment on the rig that it is for.

    The validation is the training where the experiment has none of its own. seed: of the rig's
    noise and offsets, default its own. plant: parts other than the rig's own, such as
    friction="cyclic".
    """
    loaded = load_experiment(experiment)
    validation = loaded.validation()
    rig, device = rig_of(experiment)
    own = device.options
    changes = {"seed": own.seed if seed is None else seed}
    device = SimulatedDevice(
        own.model_copy(update=changes | {"plant": own.plant.model_copy(update=plant)})
    )
    with tempfile.TemporaryDirectory() as folder:
        records = []
        for item in (loaded, validation) if validation is not None else (loaded,):
            run = run_experiment(item.experiment, item.name, rig, device, Path(folder))
            records.append(datasets.load(run.folder, model, None).dataset)
    return records[0], records[-1]


def prbs_logs(
    folder: Path, count: int, rig: Path | str = "simulated.yaml", seed: int = 0
) -> list[Path]:
    """Files of logs of the shipped PRBS, a sequence and a seed of the rig's noise each."""
    content = yaml.safe_load(find_file("protocol", "prbs.yaml").read_text(encoding="utf-8"))
    logs = []
    for k in range(count):
        for j, channel in enumerate(("motor", "brake")):
            content[channel]["seed"] = 1 + _SEEDS * (2 * k + j)
        experiment = folder / f"prbs-{k}.yaml"
        experiment.write_text(yaml.safe_dump(content))
        run = record(experiment, rig, folder / "prbs", options={"seed": seed + k})
        logs.append(run.folder / LOG_NAME)
    return logs
