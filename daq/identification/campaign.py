"""Campaigns: every log with every model and every seed, over cores or a cluster."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from daq.errors import ConfigError, Terminated
from daq.files import make_folder, stamp, write_whole
from daq.identification import records
from daq.identification.fit import assemble, check_writable, faults_of, load_logs, tell_starts
from daq.identification.records import LoggedRecord
from daq.identification.request import SettingsRequest
from daq.identification.result import Identification
from daq.identification.settings import Problem, gassi_settings, problems_of
from daq.logs.capture import LOG_NAME
from daq.lookup.models import without_folders
from daq.progress import Progress, Watch, ignore, warn
from daq.provenance import software_versions
from daq.views import Shown
from sysid import Campaign, Dataset, ModelError, Outcome, Run
from sysid import campaign as run_campaign

_SEEDS_HELP = "write 0:10 for the seeds 0 to 9, or 3,5,8"
_MOST_SEEDS = 1_000_000
_WRITE_EVERY = 2.0  # s
_TRACKER = "ignore::UserWarning:joblib.externals.loky.backend.resource_tracker"
CONNECT_TIMEOUT = 10.0  # s to wait for a scheduler's answer


@dataclass(frozen=True)
class Workers:
    """Where runs are computed: so many processes here (-1 for all cores), or a dask cluster."""

    jobs: int | None = None
    dask: str | None = None

    @contextmanager
    def ready(self) -> Iterator[int | None]:
        """Set joblib's backend; the number of jobs to ask it for."""
        if self.jobs == 0:
            cure = "give 1 or more, -1 for all cores"
            raise ConfigError("0 runs at a time do nothing", cure=cure, key="--jobs")
        if self.dask is None:
            with _tracker_unheard():
                yield -1 if self.jobs is None else self.jobs
            return
        import joblib

        with _client(self.dask) as client, joblib.parallel_config(backend="dask", client=client):
            yield None


@contextmanager
def _tracker_unheard() -> Iterator[None]:
    """Within it a tracker of joblib begins that says nothing of what a stopped program leaves.

    It takes that away, which is its task; a process of its own, it hears of filters by the
    environment alone.
    """
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (before, _TRACKER)))
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


@dataclass(frozen=True)
class Group:
    """Logs that one parameter set is fitted to, and those it is validated on, for one model.

    model_name: as tables show it, a file without its folder.
    """

    problem: Problem
    model_name: str
    name: str
    training: list[LoggedRecord]
    validation: list[LoggedRecord]

    @property
    def datasets(self) -> tuple[list[Dataset], list[Dataset]]:
        """Records for training and for validation."""
        return [log.dataset for log in self.training], [log.dataset for log in self.validation]

    def runs(self, seeds: Sequence[int]) -> list[Run]:
        """One run for each seed."""
        problem, settings = self.problem, gassi_settings(self.problem)
        names, (training, validation) = (self.model_name, self.name), self.datasets
        return [Run(problem.model, training, settings, seed, *names, validation) for seed in seeds]

    def result(self, outcome: Outcome) -> Identification:
        """The finished identification of a run that did not fail."""
        assert outcome.estimator is not None
        settings = self.problem.settings.model_copy(update={"seed": outcome.run.seed})
        problem = dataclasses.replace(self.problem, settings=settings)
        problem = problem.starting(outcome.estimator.estimated_starts_)
        logs = self.training, self.validation
        # Of many runs what each may lack is not worth its time.
        return assemble(problem, outcome.estimator, logs, None, ignore)


@dataclass(frozen=True)
class CampaignRequest:
    """Every log with every model and seed; together: one parameter set for all logs.

    models: by name, none for the configuration's. seeds: ``0:10`` for 0 to 9, or ``3,5,8``.

    >>> CampaignRequest([Path("runs/a"), Path("runs/b")], seeds="0:5").together
    False
    """

    logs: Sequence[Path]
    validate: Sequence[Path] = ()
    models: Sequence[str] = ()
    seeds: str | None = None
    settings: SettingsRequest = field(default_factory=SettingsRequest)
    together: bool = False
    workers: Workers = field(default_factory=Workers)
    out: Path | None = None


@dataclass(frozen=True, repr=False)
class CampaignResult(Shown):
    """All runs of a campaign, and where they were written.

    table: the CSV of all runs. files: parameters of the best run, by model and logs.

    >>> from sysid import Campaign
    >>> sorted(CampaignResult(Campaign(()), Path("campaign.csv"), {}).document)
    ['files', 'interrupted', 'runs', 'software', 'spread']
    """

    campaign: Campaign
    table: Path
    files: Mapping[tuple[str, str], Path]

    @property
    def headline(self) -> str:
        """How many runs, of how many structures, and where they are written."""
        outcomes = self.campaign.outcomes
        failed = f", {len(self.campaign.failed)} failed" if self.campaign.failed else ""
        return f"{len(outcomes)} runs{failed}, {self.table}"

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        spreads = [dataclasses.asdict(spread) for spread in self.campaign.spread()]
        for spread in spreads:
            if (key := (spread["model"], spread["data"])) in self.files:
                spread["parameters_file"] = str(self.files[key])
        return {
            "runs": [outcome.row() for outcome in self.campaign.outcomes],
            "spread": spreads,
            "interrupted": self.campaign.interrupted,
            "software": software_versions(),
            "files": {"table": str(self.table)},
        }


def campaign(wanted: CampaignRequest, watch: Watch = ignore) -> CampaignResult:
    """Identify every log with every model and seed; keep every result. Raises ConfigError.

    >>> from daq import CampaignRequest, campaign, record
    >>> from daq.identification.request import SettingsRequest
    >>> quick = SettingsRequest(options={"preset": "thesis", "generations": 2})
    >>> run = record("prbs.yaml")
    >>> result = campaign(CampaignRequest([run.folder], seeds="0:2", settings=quick))
    >>> len(result.campaign.outcomes), result.table.name
    (2, 'campaign.csv')
    """
    groups = _all_groups(wanted, watch)
    seeds = parse_seeds(wanted.seeds) or [groups[0].problem.settings.seed]
    folder = wanted.out or Path("campaigns") / stamp()
    check_writable(folder)
    outcomes: list[Outcome] = []
    written = -math.inf

    def keep(outcome: Outcome) -> None:
        """Write the table, so that little is lost with a campaign that is killed."""
        nonlocal written
        outcomes.append(outcome)
        # Not at each of thousands: writing is of all that there is.
        if time.perf_counter() - written > _WRITE_EVERY:
            _write_table(folder, Campaign(tuple(outcomes)))
            written = time.perf_counter()

    try:
        result = run_all(groups, seeds, wanted.workers, watch, keep)
    except Terminated as stop:
        if outcomes:
            stop.add_note(f"they stand in {_write_table(folder, Campaign(tuple(outcomes)))}")
        raise
    table = _write_table(folder, result)
    by_key = {(group.model_name, group.name): group for group in groups}
    best, files = result.best(), {}

    def report(done: int) -> None:
        watch(Progress("Intervals", done, len(best), f"{done}/{len(best)} of the best runs"))

    report(0)  # from when on it is timed
    for place, (key, outcome) in enumerate(best.items(), 1):
        files[key] = by_key[key].result(outcome).save(folder / f"best-{place}")
        report(place)
    return CampaignResult(result, table, files)


def _all_groups(wanted: CampaignRequest, watch: Watch) -> list[Group]:
    """Every log by itself, or all together, under every model, or its own where none is named."""
    if wanted.together or wanted.models:
        names = distinct(wanted.models)
        sets = [list(wanted.logs)] * len(names)
    else:
        sets = records.by_intended_model(wanted.logs)
        names = [None] * len(sets)
    with_validation = [[*logs, *wanted.validate] for logs in sets]
    problems = problems_of(wanted.settings, names, watch, logs_of=with_validation)
    shown = without_folders(problem.model_name for problem in problems)
    groups = []
    for problem, logs in zip(problems, sets, strict=True):
        name = shown[problem.model_name]
        groups += groups_of(problem, name, logs, wanted.validate, wanted.together)
    return groups


def run_all(
    groups: Sequence[Group],
    seeds: Sequence[int],
    workers: Workers,
    watch: Watch,
    on_outcome: Callable[[Outcome], None],
) -> Campaign:
    """Run all groups with all seeds, warn of their logs; ConfigError when no run succeeds."""
    warnings = [log.warning for group in groups for log in (*group.training, *group.validation)]
    warn(watch, *dict.fromkeys(warnings))
    doubts = [
        fault.sentence
        for group in groups
        for fault in faults_of(group.problem, (group.training, group.validation))
        if fault.severity == "doubt"
    ]
    warn(watch, *dict.fromkeys(doubts))
    runs = [run for group in groups for run in group.runs(seeds)]
    finished = 0

    def report(outcome: Outcome) -> None:
        nonlocal finished
        finished += 1
        on_outcome(outcome)
        end = "failed" if outcome.problem else f"error {outcome.error:.3g}"
        of_run = f"{outcome.run.name}, seed {outcome.run.seed}: {end}"
        status = f"{finished}/{len(runs)} runs, {of_run}"
        watch(Progress("Identification", finished, len(runs), status))

    watch(Progress("Identification", 0, len(runs), f"0/{len(runs)} runs"))
    with workers.ready() as jobs:
        try:
            result = run_campaign(runs, n_jobs=jobs, on_outcome=report)
        except ModelError as error:  # a model that cannot travel to another process
            raise ConfigError(str(error)) from None
        except Terminated as stop:
            stop.add_note(f"{finished} of {len(runs)} runs had been finished")
            raise
    fitted = (outcome.estimator for outcome in result.outcomes if outcome.estimator is not None)
    tell_starts(dict.fromkeys(name for e in fitted for name in e.estimated_starts_), watch)
    if result.failed and len(result.failed) == len(result.outcomes):
        raise ConfigError(result.failed[0].problem)
    if result.interrupted and not result.outcomes:
        raise KeyboardInterrupt
    return result


def groups_of(
    problem: Problem,
    model_name: str,
    logs: Sequence[Path],
    validate: Sequence[Path],
    together: bool,
) -> list[Group]:
    """The logs for one model, each by itself or all together, less what is held back of them.

    model_name: as tables show it.
    """
    training, validation = load_logs(problem, logs, validate)
    sets = list(zip(_log_names(training), [[log] for log in training], strict=True))
    if together and len(training) != 1:
        sets = [(f"{len(training)} logs", training)]
    groups = []
    for name, train in sets:
        begins, ends = records.hold_back(train, problem.settings.hold_back)
        groups.append(Group(problem, model_name, name, begins, [*ends, *validation]))
    return groups


def parse_seeds(text: str | None) -> list[int]:
    """``0:10`` as the seeds 0 to 9, ``3,5,8`` or ``7`` as they stand; nothing for None."""
    if text is None:
        return []
    try:
        if ":" in text:
            first, end = text.split(":")
            seeds: Sequence[int] = range(int(first or 0), int(end))
        else:
            seeds = [int(part) for part in text.split(",")]
        problem = "" if seeds else f"{text!r} holds no seed"
        if len(seeds) > _MOST_SEEDS:
            raise ConfigError(
                f"{text!r} makes {len(seeds)} seeds, of which {_MOST_SEEDS} are the most",
                cure=_SEEDS_HELP, key="--seeds",
            )  # fmt: skip
        outside = [seed for seed in seeds if not 0 <= seed < 2**32]
        problem = f"{outside[0]} is outside 0 .. 4294967295" if outside else problem
    except ValueError:
        problem = f"{text!r} is no list of seeds"
    if problem:
        raise ConfigError(problem, cure=_SEEDS_HELP, key="--seeds")
    return list(dict.fromkeys(seeds))


def distinct(models: Sequence[str]) -> list[str | None]:
    """The models named, None for the default; ConfigError when one is named twice."""
    for name in models:
        if models.count(name) > 1:
            raise ConfigError(f"{name} is given twice", cure="name each model once", key="--model")
    return [*models] or [None]


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        import distributed
    except ImportError:
        cure = "install it with: pip install 'hybrid-rig[cluster]'"
        raise ConfigError("dask is not installed", cure=cure, key="--dask") from None
    connect: Any = distributed.Client
    try:
        client = connect(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"no scheduler answers at {address} ({type(error).__name__})",
            cure="start one with 'dask scheduler', workers with 'dask worker ADDRESS', and give "
            "the address that it prints, as tcp://192.168.0.10:8786",
            key="--dask",
        ) from None
    with client:
        if not client.ncores():
            cure = f"start some with 'dask worker {address}'"
            raise ConfigError(f"the scheduler at {address} has no workers", cure=cure, key="--dask")
        yield client


def _log_names(logs: Sequence[LoggedRecord]) -> list[str]:
    """Names that tell logs apart: the capture folder's, or the file's."""
    paths = [log.path for log in logs]
    names = [path.parent.name if path.name == LOG_NAME else path.stem for path in paths]
    named = zip(names, paths, strict=True)
    return [str(path) if names.count(name) > 1 else name for name, path in named]


def _write_table(folder: Path, result: Campaign) -> Path:
    make_folder(folder)
    path = folder / "campaign.csv"
    write_whole(path, result.frame().to_csv(index=False, lineterminator="\n"))
    return path
