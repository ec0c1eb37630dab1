"""The scope: what looking on costs a run, updates a second, and a long log.

    python -m benchmarks.scope [--seconds 20] [--minutes 30] [--json]

The same real-time run at 800 Hz, first alone, then with the page open in headless Chromium (which
paints without a graphics card here, so that its share of a processor is the worst case). The
bars: 30 updates a second in the browser, each painted, no flagged sample and no later blocks of
samples than alone; a log of half an hour shown within 15 s, in less than 400 MB.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from benchmarks import _common
from daq.hal import Samples
from daq.logs.writer import LogWriter

RIG = (sys.executable, "-m", "daq.cli")
RATE = 800.0  # Hz
# Updates that the browser has come to, and how often it has painted a figure; a browser that
# cannot keep up paints several updates at once.
_SEEN = (
    "const named = (name) => Bokeh.documents[0].get_model_by_name(name);"
    "const view = Bokeh.index.find_one(named('figure of omega'));"
    "return [named('seen').start, view?._render_count ?? 0]"
)
_LAST = (
    "if (!(window.Bokeh?.documents?.length)) return [0, null];"
    "const t = Bokeh.documents[0].get_model_by_name('samples')?.data.t ?? [];"
    "return [t.length, t[t.length - 1]]"
)
_EXPERIMENT = """
protocol: prbs
sample_rate: 800
duration: {seconds}
calibration: {{samples: 100}}
motor: {{amplitude: 0.75, offset: 0.1, minimum_period: 0.005, seed: 4}}
brake: {{amplitude: 0.07, offset: 0.07, minimum_period: 0.05, seed: 5}}
"""
_REAL_TIME = "{name: simulated rig, backend: simulated, options: {time: real}}\n"


@contextlib.contextmanager
def scope(root: Path, *args: str) -> Iterator[tuple[psutil.Process, str]]:
    process = subprocess.Popen(
        [*RIG, "scope", "--no-browser", "--port", "0", *args],
        cwd=root, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        try:
            yield psutil.Process(process.pid), process.stdout.readline().split()[0]
        finally:
            process.terminate()


@contextlib.contextmanager
def chromium(address: str) -> Iterator[tuple[webdriver.Chrome, psutil.Process]]:
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1300,1200"):
        options.add_argument(argument)
    service = Service(shutil.which("chromedriver"))
    with webdriver.Chrome(options=options, service=service) as driver:
        driver.get(address)
        yield driver, psutil.Process(service.process.pid)


def processor(process: psutil.Process) -> float:
    """Seconds of processor that a process and those it started have used."""
    used = 0.0
    for each in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            times = each.cpu_times()
            used += times.user + times.system
    return used


def run(
    root: Path, watched: list[psutil.Process], driver: webdriver.Chrome | None
) -> dict[str, Any]:
    """One run; shares of a processor, and what the run says of its own timing."""
    runs = set((root / "runs").glob("*"))
    runner = subprocess.Popen(
        [*RIG, "run", "e.yaml", "--rig", "rig.yaml"],
        cwd=root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    process = psutil.Process(runner.pid)
    newest = new_run(root / "runs", runs)
    began, seen = time.perf_counter(), driver.execute_script(_SEEN) if driver else [0, 0]
    before = [processor(each) for each in (process, *watched)]
    time.sleep(10.0)
    after = [processor(each) for each in (process, *watched)]
    seconds = time.perf_counter() - began
    now = driver.execute_script(_SEEN) if driver else [0, 0]
    updates, painted = ((new - old) / seconds for new, old in zip(now, seen, strict=True))
    runner.wait()
    timing = json.loads((newest / "run.json").read_text())["timing"]
    shares = [(b - a) / seconds for a, b in zip(before, after, strict=True)]
    return {
        "arrival": {name: timing["arrival"][name] for name in ("p99_seconds", "worst_seconds")},
        "flagged_samples": timing["flagged_samples"],
        "processor": dict(zip(("run", "scope", "browser"), shares, strict=False)),
        "updates_per_second": updates if driver else None,
        "painted_per_second": painted if driver else None,
        "load": psutil.getloadavg()[0],
    }


def new_run(runs: Path, before: set[Path]) -> Path:
    """The run that has just begun to log samples."""
    while True:
        for folder in set(runs.glob("*")) - before:
            log = folder / "log.csv"
            if log.exists() and log.read_bytes().count(b"\n") > 2:
                return folder
        time.sleep(0.1)


def long_log(root: Path, minutes: float) -> dict[str, Any]:
    """Time until a finished log of so many minutes is shown whole, and the scope's memory."""
    n, rng = round(minutes * 60 * RATE), np.random.default_rng(0)
    with LogWriter(root / "log.csv") as log:
        for first in range(0, n, 48_000):
            size = min(48_000, n - first)
            fields = {name: rng.normal(size=size) for name in Samples.__dataclass_fields__}
            tick = np.arange(first, first + size)
            fields |= {"tick": tick, "time": tick / RATE, "flags": np.zeros(size, dtype=int)}
            log.append(Samples(**fields))
    last = (n - 1) / RATE
    with scope(root, "log.csv") as (process, address):
        began = time.perf_counter()
        with chromium(address) as (driver, _):
            while (shown := driver.execute_script(_LAST))[1] is None or shown[1] < 0.995 * last:
                time.sleep(0.2)
            seconds = time.perf_counter() - began
            memory = process.memory_info().rss
    size = (root / "log.csv").stat().st_size
    return {"rows": n, "bytes": size, "seconds": seconds, "memory": memory, "points": shown[0]}


def show(figures: dict[str, Any]) -> None:
    for name in ("alone", "watched"):
        found = figures[name]
        shares = ", ".join(f"{who} {share:.0%}" for who, share in found["processor"].items())
        print(
            f"{name:8} blocks: 99 % within {1e3 * found['arrival']['p99_seconds']:.0f} ms, "
            f"at worst {1e3 * found['arrival']['worst_seconds']:.0f} ms; "
            f"flagged {found['flagged_samples'] or 'none'}; of a core: {shares}; "
            f"load of the machine {found['load']:.1f}"
        )
    watched = figures["watched"]
    print(
        f"a second in the browser: {watched['updates_per_second']:.1f} updates, "
        f"{watched['painted_per_second']:.1f} times painted"
    )
    long = figures["long log"]
    print(
        f"log of {long['rows']} rows ({long['bytes'] / 1e6:.0f} MB): shown whole after "
        f"{long['seconds']:.1f} s as {long['points']} points, scope's memory "
        f"{long['memory'] / 1e6:.0f} MB"
    )


def main() -> None:
    parser = _common.arguments(__doc__ or "")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a run")
    parser.add_argument("--minutes", type=float, default=30.0, help="length of the long log")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        (root / "e.yaml").write_text(_EXPERIMENT.format(seconds=args.seconds))
        (root / "rig.yaml").write_text(_REAL_TIME)
        figures: dict[str, Any] = {"alone": run(root, [], None)}
        with scope(root) as (process, address), chromium(address) as (driver, browser):
            figures["watched"] = run(root, [process, browser], driver)
        figures["long log"] = long_log(root, args.minutes)
    _common.report(figures, args.json, show)


if __name__ == "__main__":
    main()
