"""``kill -9`` of real-time runs at random instants: does every log load, and what is lost?

    python -m benchmarks.kill [--kills 50] [--seed 1] [--json]

Each run is a ``rig run`` process of its own on a backend that notes when its clock started.
The simulated device latches sample k at k/rate after that, so that what a log lacks at the time
of the kill is known without trusting the process that was killed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from daq.errors import ConfigError
from daq.logs.recording import load

RATE = 800.0  # Hz
LONGEST = 2.0  # s into the run phase that a kill may come
_PATIENCE = 120.0  # s for a process to begin its run
_TRIES = 4
# What a run says that has ended itself because this computer left it without a processor.
_STARVED = ("this computer's clock allow", "the device has not returned", "without a pause")

_BACKEND = '''
import time
from pathlib import Path

from daq.hal import Mode
from sim_rig.backend import SimulatedDevice, Simulation


class Options(Simulation):
    started: str


class ClockedDevice(SimulatedDevice):
    """The simulated rig; notes when it was told to start, which is before its clock does."""

    Options = Options

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        if mode is Mode.OPEN_LOOP:
            path = Path(self.options.started)
            path.with_suffix(".tmp").write_text(repr(time.perf_counter()))
            path.with_suffix(".tmp").replace(path)
'''

_EXPERIMENT = f"""
protocol: prbs
sample_rate: {RATE:g}
duration: 600
calibration: {{samples: 8}}
motor: {{amplitude: 0.75, offset: 0.1, minimum_period: 0.005, seed: 4}}
brake: {{amplitude: 0.07, offset: 0.07, minimum_period: 0.05, seed: 5}}
"""


@dataclass(frozen=True)
class Kill:
    """One kill: when it came [s into the run phase], and what became of the log.

    lost: upper bound on how long before the kill the oldest missing sample was measured [s].
    starved: how long the process had waited for a processor in the last second [s].
    """

    after: float
    loaded: bool
    named_interrupted: bool
    rows: int
    torn: bool
    lost: float
    starved: float
    error: str | None


class _EndedError(RuntimeError):
    """A run that was over before it was to be killed; with what it said."""

    @property
    def starved(self) -> bool:
        """Whether this computer, being too busy, was why."""
        return any(words in str(self) for words in _STARVED)


def kill_once(folder: Path, after: float) -> Kill:
    """Start a run in ``folder`` and kill it ``after`` seconds into its run phase.

    A run that a busy computer has made end itself, as it should, is no case of a killed one and is
    begun again, a few times. Raises RuntimeError for one that ends otherwise.
    """
    for attempt in range(1, _TRIES):
        try:
            return _kill(folder / str(attempt), after)
        except _EndedError as error:
            if not error.starved:
                raise
            print(f"begun again, the computer being too busy: {error}", file=sys.stderr)
    return _kill(folder / str(_TRIES), after)


def _kill(folder: Path, after: float) -> Kill:
    environment = _prepare(folder)
    with (folder / "stderr").open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "daq.cli", "run", "e.yaml", "--rig", "rig.yaml"],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
        )
    try:
        started = _first_row(folder, process)
        waits: list[tuple[float, float]] = []
        while (now := time.perf_counter()) < started + after:
            waits.append((now, _waited(process.pid)))
            time.sleep(min(0.05, started + after - now))
        waited = _waited(process.pid)
        _require_running(folder, process)
        os.kill(process.pid, signal.SIGKILL)
        killed = time.perf_counter()
    finally:
        process.kill()
        process.wait()
    recent = [wait for at, wait in waits if at >= killed - 1.0]
    return _judge(folder, after, killed - started, waited - min(recent, default=waited))


def kill_many(folder: Path, afters: list[float], at_once: int = 4) -> list[Kill]:
    """Kills at the given instants, ``at_once`` processes at a time."""
    folders = [folder / f"{index:03d}" for index in range(len(afters))]
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(kill_once, folders, afters))


def instants(n: int, seed: int) -> list[float]:
    """Random instants in the run phase [s]."""
    return np.random.default_rng(seed).uniform(0.0, LONGEST, n).tolist()


def _prepare(folder: Path) -> dict[str, str]:
    folder.mkdir(parents=True)
    info = folder / "plugin" / "clocked-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clocked\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rig.backends]\nclocked = clocked:ClockedDevice\n")
    (folder / "plugin" / "clocked.py").write_text(_BACKEND)
    (folder / "e.yaml").write_text(_EXPERIMENT)
    options = {"time": "real", "started": str(folder / "started")}
    (folder / "rig.yaml").write_text(json.dumps({"backend": "clocked", "options": options}))
    paths = [str(folder / "plugin"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def _first_row(folder: Path, process: subprocess.Popen[bytes]) -> float:
    """When the device was started [monotonic s], once the log holds its first two rows."""
    deadline = time.perf_counter() + _PATIENCE
    while time.perf_counter() < deadline:
        logs = list((folder / "runs").glob("*/log.csv"))
        if logs and (folder / "started").exists() and logs[0].read_bytes().count(b"\n") > 2:
            return float((folder / "started").read_text())
        _require_running(folder, process)
        time.sleep(0.002)
    raise RuntimeError(f"{folder}: the run did not begin within {_PATIENCE:g} s")


def _require_running(folder: Path, process: subprocess.Popen[bytes]) -> None:
    status = process.poll()
    if status is not None:
        output = (folder / "stderr").read_text(errors="replace")
        raise _EndedError(f"{folder}: the run ended by itself (exit status {status}): {output}")


def _waited(pid: int) -> float:
    """How long a process has waited for a processor so far [s]; 0 where that is not known."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError, ValueError):
        return 0.0


def _judge(folder: Path, after: float, ran: float, starved: float) -> Kill:
    (run,) = (folder / "runs").iterdir()
    try:
        recording = load(run)
    except ConfigError as error:
        return Kill(after, False, False, 0, False, ran, starved, str(error))
    frame = recording.frame
    whole = bool(np.array_equal(frame["tick"], np.arange(len(frame))))
    # The oldest missing sample is the one after the last row.
    lost = ran - float(frame["tick"].iloc[-1] + 1) / RATE
    return Kill(
        after=after,
        loaded=whole,
        named_interrupted="interrupted" in (recording.warning or ""),
        rows=len(frame),
        torn=recording.torn,
        lost=lost,
        starved=starved,
        error=None if whole else "a tick is missing",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="kill -9 of real-time runs")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        kills = kill_many(Path(folder), instants(chosen.kills, chosen.seed))
    summary = {
        "kills": len(kills),
        "seed": chosen.seed,
        "loaded": sum(kill.loaded for kill in kills),
        "named_interrupted": sum(kill.named_interrupted for kill in kills),
        "torn_last_lines": sum(kill.torn for kill in kills),
        "worst_loss_seconds": max(kill.lost for kill in kills),
        "median_loss_seconds": float(np.median([kill.lost for kill in kills])),
    }
    if chosen.json:
        print(json.dumps({**summary, "each": [asdict(kill) for kill in kills]}, indent=2))
        return
    print(
        f"{summary['loaded']} of {len(kills)} logs loaded, {summary['named_interrupted']} named "
        f"interrupted, {summary['torn_last_lines']} with a cut last line (seed {chosen.seed})"
    )
    print(
        f"Lost at most {1e3 * summary['worst_loss_seconds']:.1f} ms before the kill, "
        f"{1e3 * summary['median_loss_seconds']:.1f} ms in the median"
    )


if __name__ == "__main__":
    main()
