"""How long a user waits: commands timed as whole processes, warm, beside the bars.

python -m benchmarks.waiting [--json] [--base COMMIT] [--runs 3] [--first] [COMMAND ...]
python -m benchmarks.waiting [--json] [--base COMMIT] [--runs 3] --logs 1,4,8
python -m benchmarks.waiting [--json] [--base COMMIT] [--runs 3] --catalogue 10000

Seconds by the clock and of the processors (which hardly depend on what else the machine does), to
the last line of the printed tables and to the end; the least of some runs. --base: the same of
another commit, its sources in a worktree of their own, turn by turn with these. --first: the run
that compiles, too. --logs: so many logs identified jointly instead, a PRBS each. --catalogue: so
many identified runs listed and searched instead, which have been looked at before. Not on Windows.
The search alone is timed by ``benchmarks.identification``.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks._common import arguments, prbs_logs, report

_ROOT = Path(__file__).parent.parent
_TABLE = b"Parameters: "  # stands below the tables
# Compiled Python is kept, as a user's is, and what is printed comes at once.
_VARIABLES = {"PYTHONDONTWRITEBYTECODE": None, "PYTHONUNBUFFERED": "1"}
_MEASURES = ("table", "table_cpu", "whole", "whole_cpu")


@dataclass(frozen=True)
class Command:
    """Words behind ``rig``, and bars in seconds by the clock on two quiet cores.

    {run}, {validation}: folders of runs; {parameters}: identified from them; {many}: a folder of
    identified ones; {logs}: as many logs as ``logs`` says. table: to the printed tables. first:
    whether nothing is compiled yet.
    """

    words: str
    whole: float | None
    table: float | None = None
    first: bool = False
    logs: int = 0


COMMANDS = {
    "run": Command("run prbs.yaml --identify", 7.0, 4.0),
    "identify": Command("identify {run} --out identified", None, 3.0),
    "replay": Command("replay {validation} --parameters {parameters}", 2.0),
    "figures": Command("figures {run} --out figures", 5.0),
    "models": Command("models", 0.5),
}
FIRST = {"first": Command("run prbs.yaml --identify", 25.0, first=True)}
CATALOGUE = {
    "list": Command("runs --in {many}", 1.0),
    "search": Command("runs --in {many} 'K_m>0.1'", 1.0),
    "word": Command("runs --in {many} prbs --sort K_m --last 20", 1.0),
}
JOINT_BARS = {8: 6.0}  # by number of logs


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("--base", metavar="COMMIT", help="time the same of another commit, too")
    parser.add_argument("--runs", type=int, default=3, help="of which the least counts")
    parser.add_argument("--first", action="store_true", help="the run that compiles, too")
    parser.add_argument("--logs", help="numbers of logs that are identified jointly, as 1,4,8")
    parser.add_argument("--catalogue", type=int, default=0, help="runs that are listed, searched")
    options = parser.parse_args()
    if unknown := set(options.commands) - set(COMMANDS):
        parser.error(f"no command {', '.join(unknown)}; there are {', '.join(COMMANDS)}")
    commands = {name: COMMANDS[name] for name in options.commands or COMMANDS}
    if options.logs:
        counts = list(map(int, options.logs.split(",")))
        commands = {f"{count} logs": _joint(count) for count in counts}
    if options.catalogue:
        commands = CATALOGUE
    with _sources(options.base) as base, tempfile.TemporaryDirectory() as folder:
        trees = {"here": _ROOT} | ({} if base is None else {options.base: base})
        most = max(command.logs for command in commands.values())
        logs = prbs_logs(Path(folder), most)
        places = {name: _prepared(tree, Path(folder) / str(k), options.catalogue)
                  for k, (name, tree) in enumerate(trees.items())}  # fmt: skip
        figures = {
            name: _least(command, trees, places, logs, 1 if command.first else options.runs)
            for name, command in {**commands, **(FIRST if options.first else {})}.items()
        }
    report({"waiting": figures}, options.json, show)


def _joint(count: int) -> Command:
    return Command(
        "identify {logs} --out identified", None, table=JOINT_BARS.get(count), logs=count
    )


@contextmanager
def _sources(commit: str | None) -> Iterator[Path | None]:
    """Sources of a commit, in a worktree that is taken away again."""
    if commit is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(_ROOT), "worktree"]
        subprocess.run(
            [*git, "add", "--detach", str(tree), commit], check=True, capture_output=True
        )
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def _prepared(tree: Path, place: Path, n_catalogued: int) -> dict[str, str]:
    """A working folder with runs, identified by these sources; what commands are filled with."""
    place.mkdir()
    _timed(["run", "prbs.yaml", "--identify"], tree, place, None)
    run, validation = sorted((place / "runs").iterdir())
    parameters, many = run / "identification" / "parameters.yaml", place / "many"
    for k in range(n_catalogued):
        copy = many / f"{k:05d}" / "identification"
        copy.mkdir(parents=True)
        shutil.copy(run / "run.json", copy.parent)
        shutil.copy(parameters, copy)
    if n_catalogued:
        _timed(["runs", "--in", str(many)], tree, place, None)
    return {"place": str(place), "run": str(run), "validation": str(validation),
            "parameters": str(parameters), "many": str(many)}  # fmt: skip


def _least(
    command: Command,
    trees: dict[str, Path],
    places: dict[str, dict[str, str]],
    logs: list[Path],
    runs: int,
) -> dict[str, Any]:
    """Least seconds of some runs by each tree's sources, turn by turn, and the bars."""
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
    for _ in range(runs):
        for name, tree in trees.items():
            some = shlex.join(str(log) for log in logs[: command.logs])
            quoted = {key: shlex.quote(value) for key, value in places[name].items()}
            words = shlex.split(command.words.format(**quoted, logs=some))
            nowhere = tempfile.TemporaryDirectory() if command.first else nullcontext(None)
            with nowhere as cache:
                measured[name].append(_timed(words, tree, Path(places[name]["place"]), cache))
    least = {
        name: {key: min(run[key] for run in all_runs) for key in _MEASURES}
        for name, all_runs in measured.items()
    }
    return {"bars": {"table": command.table, "whole": command.whole}, "seconds": least}


def _timed(words: list[str], tree: Path, place: Path, cache: str | None) -> dict[str, float]:
    """Seconds of a process by the clock and of the processors; cache: for compiled kernels."""
    variables = {**os.environ, **_VARIABLES, "PYTHONPATH": str(tree)}
    if cache is not None:
        variables |= {"RIG_CACHE_DIR": cache, "NUMBA_CACHE_DIR": cache}
    environment = {name: value for name, value in variables.items() if value is not None}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "daq", *words], cwd=place, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert process.stdout is not None
    table = table_cpu = float("nan")
    with process.stdout:
        for line in process.stdout:
            if line.startswith(_TABLE):
                table, table_cpu = time.perf_counter() - start, _cpu_so_far(process.pid)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"rig {' '.join(words)}: exit status {process.returncode}")
    whole = time.perf_counter() - start
    return dict(zip(_MEASURES, (table, table_cpu, whole, usage.ru_utime + usage.ru_stime),
                    strict=True))  # fmt: skip


def _cpu_so_far(process: int) -> float:
    """Processor seconds of a running process, where the system tells."""
    status = Path(f"/proc/{process}/stat")
    if not status.exists():
        return float("nan")
    user, system = status.read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def show(figures: dict[str, Any]) -> None:
    print(f"{'seconds':22s}{'to the table':>14s}{'of CPU':>8s}{'bar':>6s}", end="")
    print(f"{'to the end':>14s}{'of CPU':>8s}{'bar':>6s}")
    for command, result in figures["waiting"].items():
        bars = {key: "" if bar is None else f"{bar:g}" for key, bar in result["bars"].items()}
        for name, least in result["seconds"].items():
            cells = [f"{least[key]:.2f}" if least[key] == least[key] else "" for key in _MEASURES]
            print(f"{command if name == 'here' else '  ' + name[:12]:22s}", end="")
            print(f"{cells[0]:>14s}{cells[1]:>8s}{bars['table']:>6s}", end="")
            print(f"{cells[2]:>14s}{cells[3]:>8s}{bars['whole']:>6s}")


if __name__ == "__main__":
    main()
