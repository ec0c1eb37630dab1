"""A random fault in a random rig at a random instant: is it caught, how soon, how bad was it?

    python -m benchmarks.faults [--trials 2000] [--seed 1] [--rows] [--json]
    python -m benchmarks.faults --each [--line]
    python -m benchmarks.faults --alarms 200 [--protocol prbs.yaml ...]

Every trial is a whole run, calibration and homing with it, in virtual time on the independent
device of ``tests/faults``: a plant drawn at random, a fault that begins in the calibration, the
homing or the run, in open loop (prbs) or closed loop (constant_velocity). Limits are those of the
shipped rig files. Speed, currents and energy are the plant's, from the fault's instant until one
second after the run. ``--each``: every fault once in either loop, in the middle of the plants;
``--line``: in real time, with the device at the other end of a socket. ``--alarms``: runs of every
shipped protocol without any fault.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import statistics
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml

from benchmarks._common import arguments, report
from daq.config.rig import LimitSettings
from daq.diagnose import punctuality
from daq.errors import RigError
from daq.lookup.rigs import rig_for
from daq.lookup.shipped import find_file, shipped_files
from daq.progress import Event, Note
from daq.recording.session import open_session
from tests.faults.board import Setting
from tests.faults.faults import FAULTS, ON_A_LINE, VIRTUAL
from tests.faults.serial_device import Server, serving

_DEVICE = Path(__file__).parents[1] / "tests" / "faults" / "device.py"
_AT = 0.6  # s of the run at which a fault begins, where open loop excites and closed loop turns
_RATE = 800.0  # Hz, of the shipped experiments
_PHASES = {"calibration": 0.15, "homing": 0.15, "run": 0.7}  # and the share of trials
_LASTS = {"calibration": 4.0, "homing": 5.0}  # s
# What differs from the shipped experiments, and how long the fault may wait in the run [s].
_LOOPS: dict[str, tuple[str, dict[str, Any], float]] = {
    "open": ("prbs.yaml", {"duration": 5}, 4.0),
    "closed": (
        "constant_velocity.yaml",
        {
            "velocities": [20, -70, 120],
            "brake_commands": [0, 0.08],
            "measure": 0.4,
            "settling": {"tolerance": 5, "least": 0.5, "time": 0.2, "timeout": 4},
        },
        5.0,
    ),
}
# Of a fault that begins soon; on a line, besides, a loop that Python closes in time.
_SHORT: dict[str, dict[str, Any]] = {
    "open": {"duration": 4, "homing": {"turns": 0.5}, "calibration": {"samples": 200}},
    "closed": {
        "velocities": [20, 120],
        "brake_commands": [0.1],
        "settling": {"tolerance": 5, "least": 0.5, "time": 0.2, "timeout": 1.5},
        "calibration": {"samples": 200},
    },
}
_SLOW_LOOP: dict[str, dict[str, Any]] = {
    "open": {},
    "closed": {
        "sample_rate": 200,
        "speed_filter": 30,
        "loop": {"proportional": 0.02, "integral": 0.3},
        "slope": 40,
    },
}
_ORDER = ("stop", "warning", "missed", "before")


@dataclass(frozen=True)
class Trial:
    """Which rig, which run, and what goes wrong in it; fault "": nothing.

    line: on a socket. short: runs of seconds.
    """

    seed: int
    protocol: str
    fault: str = ""
    loop: str = ""
    phase: str = "run"
    at: float = 0.0
    line: bool = False
    short: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a trial.

    result: "stop", "warning" at the end, "missed", or "before" where the run ended before the
    fault began. latency: from the fault to zero outputs [s]; a warning has none. Ratios are to the
    limits of the rig's file. energy: from the supply [J]. live: whether the outputs were still on
    a second after the run. seconds: of the device's time.
    """

    trial: Trial
    result: str
    reason: str
    latency: float | None
    speed: float
    current_motor: float
    current_brake: float
    energy: float
    live: bool
    seconds: float

    @property
    def worst(self) -> float:
        """The largest of the ratios."""
        return max(self.speed, self.current_motor, self.current_brake)


def draw(number: int, seed: int) -> Trial:
    """The trial of this number: faults in turn, all else at random."""
    rng = np.random.default_rng([seed, number])
    fault = VIRTUAL[number % len(VIRTUAL)]
    loop = str(rng.choice(["open"] if "free" not in FAULTS[fault].loads else list(_LOOPS)))
    protocol, _, longest = _LOOPS[loop]
    phases = dict(_PHASES)
    if loop == "closed":  # it has no homing
        phases["run"] += phases.pop("homing")
    phase = str(rng.choice(list(phases), p=list(phases.values())))
    at = float(rng.uniform(0.0, _LASTS.get(phase, longest)))
    return Trial(int(rng.integers(1, 2**31)), protocol, fault, loop, phase, at)


def perform(trial: Trial) -> Outcome:
    """One trial."""
    with contextlib.ExitStack() as stack:
        name = stack.enter_context(tempfile.TemporaryDirectory())
        folder = Path(name)
        experiment = _changed("protocol", trial.protocol, folder, _changes(trial))
        server = stack.enter_context(serving(_setting(trial))) if trial.line else None
        rig = _faulty_rig(trial, folder, server)
        notes: list[str] = []

        def watch(event: Event) -> None:
            if isinstance(event, Note) and event.level == "warning":
                notes.append(event.text)

        session = open_session(str(experiment), str(rig), watch=watch)
        stopped = ""
        try:
            # The figures of its findings take longer than the run.
            with mock.patch("daq.recording.analysis._write"):
                result = session.record(folder / "runs", validation=False, watch=watch)
            notes += [*result.doubts, *punctuality.notes(result.run)]
        except RigError as error:
            stopped = f"{type(error).__name__}: {error}"
    board = session.device.board if server is None else server.board
    return _judged(trial, session.rig.limits, board, stopped, notes)


def _changes(trial: Trial) -> dict[str, Any]:
    """What differs from the shipped experiment."""
    if not trial.loop:
        return {}
    changes = dict(_LOOPS[trial.loop][1])
    if trial.short:
        changes |= _SHORT[trial.loop]
    if trial.line:
        changes |= _SLOW_LOOP[trial.loop]
    return changes


def _judged(
    trial: Trial, limits: LimitSettings, board: Any, stopped: str, notes: list[str]
) -> Outcome:
    truth, plant = board.truth, board.plant
    begun = truth.onset is not None or not trial.fault
    # A fault that begins with the very end of the run has nothing to be seen by.
    if not begun or (trial.fault and truth.onset >= truth.ended):
        result = "before"
    else:
        result = "stop" if stopped else "warning" if notes else "missed"
    latency = None
    if result == "stop" and trial.fault:
        zero = min(time for time in (truth.safe, truth.ended) if time is not None)
        latency = max(0.0, zero - truth.onset)
    return Outcome(
        trial,
        result,
        stopped or "; ".join(notes),
        latency,
        truth.omega / (limits.speed or math.inf),
        truth.current_motor / limits.current.motor,
        truth.current_brake / limits.current.brake,
        truth.energy,
        any(abs(volts) > 0.0 for volts in truth.output),
        plant.time,
    )


def _changed(kind: Any, name: str, folder: Path, changes: dict[str, Any]) -> Path:
    """A shipped file with other values of some keys, in ``folder``."""
    source = find_file(kind, name)
    content = yaml.safe_load(source.read_text(encoding="utf-8"))
    if "file" in content:
        content["file"] = str(source.parent / content["file"])
    path = folder / name
    path.write_text(yaml.safe_dump({**content, **changes}, sort_keys=False), encoding="utf-8")
    return path


def _setting(trial: Trial) -> Setting:
    """The independent device's, with the load and the sensor of the protocol's rig file."""
    source = find_file("backend", rig_for(trial.protocol))
    plant = yaml.safe_load(source.read_text(encoding="utf-8"))["options"]["plant"]
    fault = {"fault": trial.fault, "phase": trial.phase, "at": trial.at} if trial.fault else {}
    sensor = plant.get("sensor", "load")
    return Setting(seed=trial.seed, load=plant["load"], sensor=sensor, **fault)


def _faulty_rig(trial: Trial, folder: Path, server: Server | None) -> Path:
    """The rig file that the protocol is for, with the independent device in its place."""
    changes: dict[str, Any] = {
        "backend": f"{_DEVICE}:VirtualDevice",
        "options": {name: v for name, v in asdict(_setting(trial)).items() if v is not None},
    }
    if server is not None:
        changes = {"backend": "serial", "options": {"port": server.port, "watchdog": 0.3}}
    return _changed("backend", rig_for(trial.protocol), folder, changes)


def trial_of(fault: str, loop: str, line: bool) -> Trial:
    """The fault early in a short run of the plant in the middle."""
    return Trial(0, _LOOPS[loop][0], fault, loop, at=_AT, line=line, short=True)


def each(line: bool) -> list[Trial]:
    """Every fault once in either loop, early in the run of the plant in the middle."""
    names = ON_A_LINE if line else VIRTUAL
    loops = {name: ["open"] if "free" not in FAULTS[name].loads else list(_LOOPS) for name in names}
    return [trial_of(name, loop, line) for name in names for loop in loops[name]]


def alarms(runs: int, seed: int, protocols: Sequence[str] = ()) -> Iterator[Trial]:
    """Runs without a fault of these protocols in turn; of every shipped one where none is named."""
    rng = np.random.default_rng(seed)
    protocols = protocols or list(shipped_files("protocol"))
    for number in range(runs):
        yield Trial(int(rng.integers(1, 2**31)), protocols[number % len(protocols)])


def perform_all(trials: Iterable[Trial], workers: int) -> list[Outcome]:
    """Trials in a pool of processes, in order."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        return list(pool.map(perform, trials, chunksize=4))


def table(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    """Outcomes by fault and loop, in the order of the chain, and the totals."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.trial.fault, outcome.trial.loop].append(outcome)
    names = [(fault, loop) for fault in FAULTS for loop in _LOOPS if (fault, loop) in groups]
    rows = [_row(fault, loop, groups[fault, loop]) for fault, loop in names]
    return [*rows, _row("all", "", outcomes)]


def _row(fault: str, loop: str, outcomes: list[Outcome]) -> dict[str, Any]:
    counts = Counter(outcome.result for outcome in outcomes)
    latencies = [outcome.latency for outcome in outcomes if outcome.latency is not None]
    begun = [outcome for outcome in outcomes if outcome.result != "before"]
    missed = [outcome for outcome in begun if outcome.result == "missed"]
    reasons = Counter(outcome.reason.split(":")[-1][:70] for outcome in begun if outcome.reason)
    return {
        "fault": fault,
        "loop": loop,
        "trials": len(outcomes),
        **{name: counts[name] for name in _ORDER},
        "latency_median_seconds": statistics.median(latencies) if latencies else None,
        "latency_worst_seconds": max(latencies, default=None),
        "latency_worst_samples": round(max(latencies) * _RATE) if latencies else None,
        "worst_speed": max((o.speed for o in begun), default=0.0),
        "worst_current_motor": max((o.current_motor for o in begun), default=0.0),
        "worst_current_brake": max((o.current_brake for o in begun), default=0.0),
        "worst_energy_joules": max((o.energy for o in begun), default=0.0),
        "missed_beyond_a_limit": sum(o.worst > 1.0 for o in missed),
        "live_at_the_end": sum(o.live for o in begun),
        "commonest_reason": reasons.most_common(1)[0][0] if reasons else "",
    }


def show(figures: dict[str, Any]) -> None:
    (_show_alarms if "alarms" in figures else _show_faults)(figures)


def _show_faults(figures: dict[str, Any]) -> None:
    print(f"\n{figures['trials']} trials, seed {figures['seed']}")
    print(
        f"{'fault':<28} {'loop':<6} {'trials':>6} {'stop':>5} {'warn':>5} {'miss':>5} {'early':>5} "
        f"{'median':>9} {'worst':>10} {'(samples)':>9} {'speed':>6} {'i_m':>5} {'i_b':>5} "
        f"{'J':>6} {'live':>5}"
    )
    for row in figures["rows"]:
        print(
            f"{row['fault']:<28} {row['loop']:<6} {row['trials']:6d} {row['stop']:5d} "
            f"{row['warning']:5d} {row['missed']:5d} {row['before']:5d} "
            f"{_milliseconds(row['latency_median_seconds']):>9} "
            f"{_milliseconds(row['latency_worst_seconds']):>10} "
            f"{row['latency_worst_samples'] or '':>9} {row['worst_speed']:6.2f} "
            f"{row['worst_current_motor']:5.2f} {row['worst_current_brake']:5.2f} "
            f"{row['worst_energy_joules']:6.1f} {row['live_at_the_end']:5d}"
        )
    for outcome in figures.get("each", []):
        trial = outcome["trial"]
        print(
            f"seed {trial['seed']:<10} {trial['fault']:<28} {trial['loop']:<6} "
            f"{trial['phase']:<11} at {trial['at']:.3f} s: {outcome['result']}, speed "
            f"{outcome['speed']:.2f}: {outcome['reason']}"
        )
    totals = figures["rows"][-1]
    print(
        f"Caught {totals['stop'] + totals['warning']} of {totals['trials'] - totals['before']}; "
        f"missed and beyond a limit: {totals['missed_beyond_a_limit']}; worst speed "
        f"{totals['worst_speed']:.2f} of its limit"
    )


def _show_alarms(figures: dict[str, Any]) -> None:
    print(
        f"\n{figures['runs']} correct runs, seed {figures['seed']}: {figures['stops']} stops, "
        f"{figures['warnings']} warnings in {figures['hours']:.2f} h of device time"
    )
    for alarm in figures["alarms"]:
        trial = alarm["trial"]
        print(f"seed {trial['seed']:<10} {trial['protocol']}: {alarm['result']}: {alarm['reason']}")


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.1f} ms"


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--each", action="store_true", help="every fault once, not at random")
    parser.add_argument("--line", action="store_true", help="on a socket in real time")
    parser.add_argument("--alarms", type=int, metavar="N", help="correct runs instead of faults")
    parser.add_argument("--protocol", action="append", default=[], metavar="YAML", help="of alarms")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--rows", action="store_true", help="every trial as well")
    options = parser.parse_args()
    if options.line and not options.each:
        parser.error("--line is for --each; drawn at random, the faults take hours in real time")
    if options.alarms is not None:
        outcomes = perform_all(
            alarms(options.alarms, options.seed, options.protocol), options.workers
        )
        report(_alarm_figures(outcomes, options.seed), options.json, show)
        return
    trials = (
        each(options.line)
        if options.each
        else [draw(number, options.seed) for number in range(options.trials)]
    )
    outcomes = perform_all(trials, options.workers)
    figures: dict[str, Any] = {"trials": len(outcomes), "seed": options.seed}
    figures["rows"] = table(outcomes)
    if options.rows or options.each:
        figures["each"] = [asdict(outcome) for outcome in outcomes]
    report(figures, options.json, show)


def _alarm_figures(outcomes: list[Outcome], seed: int) -> dict[str, Any]:
    counts = Counter(outcome.result for outcome in outcomes)
    return {
        "runs": len(outcomes),
        "seed": seed,
        "stops": counts["stop"],
        "warnings": counts["warning"],
        "hours": sum(outcome.seconds for outcome in outcomes) / 3600.0,
        "alarms": [asdict(o) for o in outcomes if o.result != "missed"],
    }


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main()
