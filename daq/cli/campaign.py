"""``rig campaign``: every log with every model and every seed, over cores or a cluster."""

from __future__ import annotations

import dataclasses
import datetime
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.cli import terminal as console
from daq.cli.identify import assemble, check_writable, load_logs, write_parameters
from daq.errors import ConfigError
from daq.files import write_whole
from daq.identification import records as datasets
from daq.identification.records import Loaded
from daq.identification.result import Identified, document
from daq.identification.settings import Prepared, gassi_settings, prepare_models
from daq.logs.capture import LOG_NAME
from daq.provenance import software_versions
from sysid import Campaign, ModelError, Outcome, Run, Spread, campaign

_SEEDS_HELP = "write 0:10 for the seeds 0 to 9, or 3,5,8"
_WRITE_EVERY = 2.0  # s
_CONNECT = 10  # s to wait for a scheduler's answer


@dataclass(frozen=True)
class Workers:
    """Where runs are computed: so many processes here (-1 for all cores), or a dask cluster."""

    jobs: int | None = None
    dask: str | None = None

    @contextmanager
    def ready(self) -> Iterator[int | None]:
        """Set joblib's backend; the number of jobs to ask it for."""
        if self.jobs == 0:
            raise ConfigError(
                "--jobs: 0 runs at a time do nothing; give 1 or more, -1 for all cores"
            )
        if self.dask is None:
            yield -1 if self.jobs is None else self.jobs
            return
        import joblib

        with _client(self.dask) as client, joblib.parallel_config(backend="dask", client=client):
            yield None


@dataclass(frozen=True)
class Group:
    """Logs that one parameter set is fitted to, and those it is validated on, for one model."""

    prepared: Prepared
    name: str
    training: list[Loaded]
    validation: list[Loaded]

    def runs(self, seeds: Sequence[int]) -> list[Run]:
        """One run for each seed."""
        settings = gassi_settings(self.prepared.settings)
        return [
            Run(
                self.prepared.model,
                [log.dataset for log in self.training],
                settings,
                seed,
                self.prepared.model_name,
                self.name,
                [log.dataset for log in self.validation],
            )
            for seed in seeds
        ]

    def report(self, outcome: Outcome) -> dict[str, Any]:
        """What ``rig identify`` would have reported of it."""
        return document(self.result(outcome))

    def result(self, outcome: Outcome) -> Identified:
        """The finished identification of a run that did not fail."""
        assert outcome.estimator is not None
        settings = self.prepared.settings.model_copy(update={"seed": outcome.run.seed})
        prepared = dataclasses.replace(self.prepared, settings=settings)
        return assemble(prepared, outcome.estimator, self.training, self.validation, True)


def campaign_command(
    logs: list[Path],
    validate: list[Path],
    models: list[str],
    config: Path | None,
    out: Path | None,
    options: Mapping[str, Any],
    settings: Sequence[str],
    seeds: str | None,
    together: bool,
    workers: Workers,
    as_json: bool,
) -> None:
    """Identify every log with every model and seed; print the spread, keep every result."""
    prepared = prepare_models(config, options, distinct(models), settings)
    drawn = parse_seeds(seeds) or [prepared[0].settings.seed]
    folder = out or _default_folder()
    check_writable(folder)
    groups = [g for p in prepared for g in groups_of(p, logs, validate, together)]
    note_warnings(groups)
    runs = [run for group in groups for run in group.runs(drawn)]
    found = run_all(runs, workers, as_json, _Keeper(folder))
    table = _write_table(folder, found)
    by_key = {(group.prepared.model_name, group.name): group for group in groups}
    files = {}
    for place, (key, outcome) in enumerate(found.best().items(), 1):
        path = write_parameters(folder / f"best-{place}", by_key[key].report(outcome))
        files[key] = path
    if as_json:
        console.print_json(_document(found, table, files))
    else:
        _print(found, table, files)


class _Keeper:
    """Writes the table as outcomes come, so that little is lost with a campaign that is killed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._done: list[Outcome] = []
        self._written = -math.inf

    def __call__(self, outcome: Outcome) -> None:
        self._done.append(outcome)
        # Not each of thousands: writing is of all that there is.
        if time.monotonic() - self._written > _WRITE_EVERY:
            _write_table(self._folder, Campaign(tuple(self._done)))
            self._written = time.monotonic()


def run_all(
    runs: Sequence[Run], workers: Workers, quiet: bool, on_outcome: Callable[[Outcome], None]
) -> Campaign:
    """All runs with their progress; ConfigError when none of them succeeds."""
    with console.progress(quiet) as bar, workers.ready() as jobs:
        finished = 0

        def watch(outcome: Outcome) -> None:
            nonlocal finished
            finished += 1
            on_outcome(outcome)
            note = f"{finished}/{len(runs)} runs, {outcome.run.name}, seed {outcome.run.seed}: " + (
                "failed" if outcome.problem else f"error {outcome.error:.3g}"
            )
            bar.update("Identification", finished, len(runs), note)

        try:
            found = campaign(runs, n_jobs=jobs, on_outcome=watch)
        except ModelError as error:  # a model that cannot travel to another process
            raise ConfigError(str(error)) from None
    if found.failed and len(found.failed) == len(found.outcomes):
        raise ConfigError(found.failed[0].problem)
    if found.interrupted and not found.outcomes:
        raise KeyboardInterrupt
    return found


def groups_of(
    prepared: Prepared, logs: list[Path], validate: list[Path], together: bool
) -> list[Group]:
    """The logs for one model, each by itself or all together, less what is held back of them."""

    training, validation = load_logs(prepared, logs, validate)
    names = [_together(training)] if together else _log_names(training)
    groups = [training] if together else [[log] for log in training]
    part, made = prepared.settings.hold_back, []
    for name, group in zip(names, groups, strict=True):
        begins, ends = datasets.hold_back(group, part)
        made.append(Group(prepared, name, begins, [*ends, *validation]))
    return made


def note_warnings(groups: Sequence[Group]) -> None:
    """Say once of each log that its run did not complete."""
    notes = [log.warning for group in groups for log in (*group.training, *group.validation)]
    for note in dict.fromkeys(notes):
        if note is not None:
            console.report_warning(note)


def parse_seeds(text: str | None) -> list[int]:
    """``0:10`` as the seeds 0 to 9, ``3,5,8`` or ``7`` as they stand; nothing for None."""
    if text is None:
        return []
    try:
        if ":" in text:
            first, end = text.split(":")
            seeds = list(range(int(first or 0), int(end)))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--seeds: {text!r} is no list of seeds; {_SEEDS_HELP}") from None
    if not seeds:
        raise ConfigError(f"--seeds: {text!r} holds no seed; {_SEEDS_HELP}")
    for seed in seeds:
        if not 0 <= seed < 2**32:
            raise ConfigError(f"--seeds: {seed} is outside 0 .. 4294967295; {_SEEDS_HELP}")
    return list(dict.fromkeys(seeds))


def distinct(models: list[str]) -> list[str | None]:
    """The models named, None for the default; ConfigError when one is named twice."""
    for name in models:
        if models.count(name) > 1:
            raise ConfigError(f"--model: {name} is given twice; name each model once")
    return [*models] or [None]


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        import distributed
    except ImportError:
        raise ConfigError(
            "--dask: dask is not installed; install it with: pip install 'hybrid-rig[cluster]'"
        ) from None
    connect: Any = distributed.Client
    try:
        client = connect(address, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"--dask: no scheduler answers at {address} ({type(error).__name__}); start one with "
            "'dask scheduler', workers with 'dask worker ADDRESS', and give the address that it "
            "prints, as tcp://192.168.0.10:8786"
        ) from None
    with client:
        if not client.ncores():
            raise ConfigError(
                f"--dask: the scheduler at {address} has no workers; start some with "
                f"'dask worker {address}'"
            )
        yield client


def _default_folder() -> Path:
    now = datetime.datetime.now(datetime.UTC)
    return Path("campaigns") / f"{now:%Y%m%dT%H%M%SZ}"


def _log_names(logs: list[Loaded]) -> list[str]:
    """Names that tell logs apart: the capture folder's, or the file's."""
    names = [log.path.parent.name if log.path.name == LOG_NAME else log.path.stem for log in logs]
    return [
        str(log.path) if names.count(name) > 1 else name
        for name, log in zip(names, logs, strict=True)
    ]


def _together(logs: list[Loaded]) -> str:
    return _log_names(logs)[0] if len(logs) == 1 else f"{len(logs)} logs"


def _write_table(folder: Path, found: Campaign) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "campaign.csv"
    write_whole(path, found.frame().to_csv(index=False, lineterminator="\n"))
    return path


def _document(
    found: Campaign, table: Path, files: Mapping[tuple[str, str], Path]
) -> dict[str, Any]:
    return {
        "runs": [outcome.row() for outcome in found.outcomes],
        "spread": [
            dataclasses.asdict(spread) | {"parameters_file": str(files[spread.model, spread.data])}
            if (spread.model, spread.data) in files
            else dataclasses.asdict(spread)
            for spread in found.spread()
        ],
        "interrupted": found.interrupted,
        "software": software_versions(),
        "files": {"table": str(table)},
    }


def _print(found: Campaign, table: Path, files: Mapping[tuple[str, str], Path]) -> None:
    console.print_line()
    console.print_table(
        "Error over seeds: mean over outputs of the RMSE in parts of max|y|",
        ["model", "log", "runs", "best", "median", "worst", "within 1 %", "fit [%]", "failed"],
        [_spread_row(spread, found) for spread in found.spread()],
        text=["log"],
    )
    for problem in dict.fromkeys(f"{o.run.name}: {o.problem}" for o in found.failed):
        console.print_line(f"Failed: {problem}")
    if found.interrupted:
        console.print_line(f"Stopped by Ctrl-C: {len(found.outcomes)} runs are in the table.")
    for (model, data), path in files.items():
        console.print_line(f"Best of {model} on {data}: {path}")
    console.print_line(f"All runs with their parameters: {table}")
    if files:
        console.print_next(f"rig replay LOG --parameters {next(iter(files.values()))}")


def _spread_row(spread: Spread, found: Campaign) -> list[str]:
    best = found.best().get((spread.model, spread.data))
    return [
        spread.model,
        spread.data,
        str(spread.runs),
        console.number(spread.best),
        console.number(spread.median),
        console.number(spread.worst),
        str(spread.agreeing),
        f"{best.row()['fit']:.1f}" if best is not None else "-",
        str(spread.failed),
    ]
