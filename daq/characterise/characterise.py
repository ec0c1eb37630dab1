"""Run, identify, design, and again, until precision, time or information end."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from daq.characterise.mounts import Ask, MountedRig, mounted_rigs
from daq.characterise.page import write_page
from daq.characterise.rounds import Interval, Request, Round, rounds_of
from daq.config import yaml_file
from daq.config.question import Question
from daq.config.yaml_file import TypedSettings
from daq.designs.design import choose, write
from daq.designs.files import DATA
from daq.designs.setup import Setup, set_up
from daq.diagnose.sampling import fastest, kept_up_with
from daq.errors import ConfigError, DeviceError, InterlockError, RigError, Terminated
from daq.files import make_folder, stamp
from daq.hal import Device
from daq.identification.fit import check_writable, fit
from daq.identification.request import CHECKPOINT, SettingsRequest
from daq.identification.result import Identification
from daq.identification.settings import problem_of
from daq.logs.capture import LOG_NAME
from daq.lookup.models import DRIVEN_MODEL, whole_name
from daq.lookup.rigs import load_rig
from daq.notation import quantity
from daq.progress import Note, Started, Watch, ignore
from daq.recording.session import SEEDS, first_seed, record
from daq.report.publication import publish
from daq.views import Lines, Shown
from sysid import Design

_FIRST = 0.25  # of the time, for a first round, from what little is known
_LATER = 0.5  # of what is left, for each that follows
_LEAST = 2  # runs of a last round: fewer join the round before
_WORTH = 0.9  # of the widths, to which another mounting must be expected to bring them
_NO_RUN = "no run within the limits would tell more"
_GAIN = 0.98  # of the widths, to which a round must be expected to bring them


@dataclass(frozen=True, repr=False)
class Characterisation(Shown):
    """A rig's parameters after all rounds, and why there are no more.

    intervals: after the last round. seconds: logged in all. verdict: of the last identification.
    precision: half width that was wanted [%], None for as narrow as the time allows.
    """

    folder: Path
    rounds: tuple[Round, ...]
    intervals: tuple[Interval, ...]
    seconds: float
    reason: str
    verdict: dict[str, Any]
    page: Path
    report: Path
    precision: float | None = None

    @property
    def missed(self) -> list[str]:
        """Quantities whose intervals are wider than wanted, or have no two ends."""
        if self.precision is None:
            return []
        return [i.name for i in self.intervals if not i.is_within(self.precision)]

    @property
    def helped_by_time(self) -> bool:
        """Whether more time would let it go on."""
        return self.reason != _NO_RUN

    @property
    def headline(self) -> str:
        """Rounds, logged time, and why it ended."""
        rounds = f"{len(self.rounds)} round{'s' * (len(self.rounds) != 1)}"
        return f"{rounds}, {self.seconds:.3g} s logged in {self.folder}: {self.reason}"

    @property
    def assumptions(self) -> list[str]:
        """What values rest on that is not estimated, in sentences."""
        return list(self.rounds[-1].result.get("assumptions", []))

    def lines(self) -> Lines:
        """Quantities with the half widths of their 95 % intervals."""
        rows = [["quantity", "value", "half width [%]", "expected [%]"]]
        for interval in self.intervals:
            widths = (interval.width, interval.expected)
            texts = ["-" if width is None else f"{100.0 * width:.2g}" for width in widths]
            rows.append([interval.name, quantity(interval.value, interval.unit), *texts])
        return rows

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        return {
            "folder": str(self.folder),
            "model": self.rounds[-1].model,
            "assumptions": self.assumptions,
            "rounds": len(self.rounds),
            "logged_seconds": self.seconds,
            "ended": self.reason,
            "quantities": [asdict(interval) for interval in self.intervals],
            "wanted_percent": self.precision,
            "missed": self.missed,
            "verdict": self.verdict,
            "parameters": str(self.rounds[-1].identification / "parameters.yaml"),
            "page": str(self.page),
            "report": str(self.report),
        }


def characterise(
    rig: str | Path = "simulated.yaml",
    time: float = 60.0,
    precision: float | None = 5.0,
    out: str | Path | None = None,
    *,
    model: str | None = None,
    plant: str | None = None,
    config: str | Path | None = None,
    settings: Sequence[str] = (),
    ask: Ask | None = None,
    watch: Watch = ignore,
) -> Characterisation:
    """Find a rig's parameters: design runs, run them, identify, and again.

    time: logged time of all runs, at most [s]. precision: half width wanted of all 95 % intervals
    [%], None for as narrow as they get. model: by default the configuration's, or else the actuator
    with the ends of its amplifiers. out: a new folder for all of it. settings: keys of the
    designs, as ``key=value``. ask: tells a person to change to another mounting of the rig's
    file where that tells more; None: it stays as it is. Raises ConfigError before anything moves,
    and what a run raises.
    """
    request = Request(
        _absolute(rig) if Path(rig).exists() else str(rig),
        time,
        precision,
        _model_of(model, config),
        None if plant is None else whole_name(plant),
        None if config is None else _absolute(config),
        tuple(settings),
        ask is not None,
    )
    _, device = load_rig(str(rig), watch=watch)
    folder = Path(out) if out is not None else Path("runs") / f"{stamp()}-characterise"
    check_writable(folder)
    questions = [
        set_up(_question(request, mounted, [], request.time), watch).question
        for mounted in mounted_rigs(request)
    ]
    request = _in_time(request, questions[0], device, watch)
    request.save(folder)
    return resume(folder, ask=ask, watch=watch)


def resume(
    folder: str | Path,
    time: float | None = None,
    precision: float | None = None,
    *,
    ask: Ask | None = None,
    watch: Watch = ignore,
) -> Characterisation:
    """Go on with a characterisation from what is there, however it ended.

    time, precision: in place of what was wanted until then, and from then on; None: as it was. ask:
    as of ``characterise``; None: the mounting stays as it is. Raises ConfigError where none has
    begun, or where not even a first round would tell anything, and what a run raises.
    """
    root = Path(folder)
    recorded = Request.load(root)
    request = recorded.changed(time, precision)
    if request != recorded:
        request.rewrite(root)
        Round(root, len(rounds_of(root)) + 1).discard_design()
    request = replace(request, ask=ask is not None)
    try:
        return _continued(root, request, ask, watch)
    except (KeyboardInterrupt, Terminated, RigError) as stop:
        if not isinstance(stop, ConfigError) or rounds_of(root):
            command = f"rig characterise --resume {shlex.quote(str(root))}"
            command += " --ask" * (ask is not None)
            again = "; what limits stop twice is left out" * isinstance(stop, InterlockError)
            stop.add_note(f"what was done so far is kept; go on with: {command}{again}")
        raise


def _continued(root: Path, request: Request, ask: Ask | None, watch: Watch) -> Characterisation:
    done = rounds_of(root)
    reason = _end(request, done)
    while not reason:
        current = Round(root, len(done) + 1)
        if not _design(current, request, done, watch):
            if not done:
                raise _nothing_to_tell(current)
            reason = _NO_RUN
            break
        _change_mounting(current, request, done, ask)
        _run(current, done, watch)
        _identify([*done, current], request, watch)
        done.append(current)
        reason = _end(request, done)
        write_page(root, done, reason, request.precision)
    last, report = done[-1], root / "report" / "report.html"
    if "missing" not in last.result or not report.exists():
        _identify(done, request, watch, ends=True)
    page = write_page(root, done, reason, request.precision)
    return Characterisation(
        root, tuple(done), tuple(last.intervals()), _spent(done), reason,
        last.result["verdict"], page, report, request.precision,
    )  # fmt: skip


def _in_time(request: Request, question: Question, device: Device, watch: Watch) -> Request:
    """A request that samples as fast as its question says, or else as fast as can be kept up with.

    Raises DeviceError for a device that is not there, or slower than was asked for.
    """
    wanted = question.rate
    if question.sample_rate is not None:
        at_most = fastest(device)
        if at_most < wanted:
            too_fast = f"sample_rate {wanted:g} Hz is too fast for it"
            raise DeviceError(f"the device samples at up to {at_most:g} Hz; {too_fast}")
        return request
    rate = kept_up_with(device, wanted, watch)
    if rate == wanted:
        return request
    return replace(request, settings=(*request.settings, f"sample_rate={rate!r}"))


def _nothing_to_tell(first: Round) -> ConfigError:
    """Why there is not even a first round, and the cure."""
    quantities = first.design["quantities"]
    if not quantities:
        problem = "the model has no free parameter that an experiment tells"
        cure = "free one in the configuration"
    else:
        best = min(quantities, key=lambda q: q["after"] / q["before"])
        widths = " to ".join(f"{100.0 * best[key]:.3g}" for key in ("before", "after"))
        problem = (
            "no run within the limits would tell the parameters better than they are known: "
            f"most it would {best['name']}, from {widths} %"
        )
        cure = "give more time or longer runs (--set run=5s), wider limits, or less noise"
    return ConfigError(f"nothing was run: {problem}", cure=cure, file=first.folder / DATA)


def _model_of(name: str | None, config: str | Path | None) -> str | None:
    """The whole name of the model; None for the one that a configuration names."""
    if name is None and config is not None and yaml_file.load(Path(config)).content.get("model"):
        return None
    return whole_name(name or DRIVEN_MODEL)


def _absolute(path: str | Path) -> str:
    return str(Path(path).resolve())


def _end(request: Request, done: Sequence[Round], result: Mapping[str, Any] | None = None) -> str:
    """Why there is no further round; empty where there is one. result: as of ``intervals``."""
    if not done:
        return ""
    if request.precision is not None:
        intervals = done[-1].intervals(result)
        if all(interval.is_within(request.precision) for interval in intervals):
            return f"all that experiments tell is known to {request.precision:g} %"
    spent = _spent(done)
    if spent + done[-1].seconds / len(done[-1].experiments) > request.time * (1.0 + 1e-9):
        left = request.time - spent
        if left > 1e-3 * request.time:
            return f"the {left:.3g} s that are left of {request.time:g} s are shorter than a run"
        return f"the {request.time:g} s are used up"
    return ""


def _spent(done: Sequence[Round]) -> float:
    return sum(each.seconds for each in done)


def _question(
    request: Request, mounted: MountedRig, done: Sequence[Round], seconds: float
) -> TypedSettings:
    """What the design of the next round is asked, of so many seconds, on a rig as it is mounted."""
    last = done[-1] if done else None
    options = {
        "rig": mounted.rig,
        "model": request.model,
        "plant": mounted.plant,
        "config": request.config,
        "parameters": None if last is None else str(last.identification),
        "log": None if last is None else str(_logs(done)[-1]),
        "time": seconds,
        "seed": len(done),
    }
    given = {key: value for key, value in options.items() if value is not None}
    return TypedSettings.of(given, list(request.settings))


def _design(current: Round, request: Request, done: Sequence[Round], watch: Watch) -> bool:
    """Design a round, unless it is there; whether it promises to tell more.

    The first one is for the rig as it is mounted, each later one for the mounting that tells most.
    """
    if not current.is_designed:
        watch(Started(f"round {current.number}"))
        at = done[-1].rig if done else request.rig
        rigs = mounted_rigs(request)
        # That on which it is comes first: where another tells hardly more nobody has to change it.
        rigs = sorted(rigs if done else rigs[:1], key=lambda mounted: mounted.rig != at)
        best: tuple[float, Setup, Design] | None = None
        for mounted in rigs:
            try:
                setup, chosen = _chosen(request, mounted, done, watch)
            except ConfigError as error:
                if best is None and mounted is rigs[-1]:
                    raise
                watch(Note("note", f"no run for the mounting of {mounted.rig}: {error}"))
                continue
            width = float(np.mean([np.log(q.after) for q in chosen.quantities]))
            if best is None or width < best[0] + math.log(_WORTH):
                best = width, setup, chosen
        assert best is not None
        write(*best[1:], current.folder)
    return any(q["after"] < _GAIN * q["before"] for q in current.design["quantities"])


def _chosen(
    request: Request, mounted: MountedRig, done: Sequence[Round], watch: Watch
) -> tuple[Setup, Design]:
    """The runs of the next round on a rig as it is mounted."""
    left = request.time - _spent(done)
    share = _LATER * left if done else _FIRST * left
    question = set_up(_question(request, mounted, done, left), watch).question
    runs, most = max(1, round(share / question.seconds)), question.most_runs
    if most - runs < _LEAST:
        runs = most
    setup = set_up(_question(request, mounted, done, runs * question.seconds))
    return setup, choose(setup, watch)


def _change_mounting(
    current: Round, request: Request, done: Sequence[Round], ask: Ask | None
) -> None:
    """Have a person mount the rig for a round, unless it is mounted so.

    Raises ConfigError where nobody can be asked.
    """
    at = done[-1].rig if done else request.rig
    if current.rig == at or any(current.captures(each) for each in current.experiments):
        return
    changes = {each.rig: each.change for each in mounted_rigs(replace(request, ask=True))}
    change = changes.get(current.rig, f"mount it as {current.rig} says")
    if ask is None:
        cure = "go on with --ask, and change it when it says so"
        problem = f"round {current.number} is for another mounting: {change}"
        raise ConfigError(problem, cure=cure, file=current.folder / DATA)
    ask(f"round {current.number}: {change} ({current.rig})")


def _run(current: Round, done: Sequence[Round], watch: Watch) -> None:
    """Run what of a round's experiments has not been run to its end.

    A simulated rig makes the same noise from the same seed: each run has a seed of its own.
    """
    config, _ = load_rig(current.rig, watch=watch)
    has_noise = "seed" in type(config.options).model_fields
    chosen: int | None = getattr(config.options, "seed", None)
    seed = first_seed(current.runs) if chosen is None else chosen
    first = sum(len(each.experiments) for each in done)
    for place, experiment in enumerate(current.experiments, first):
        if current.is_left_out(experiment):
            watch(Note("warning", f"{experiment.stem} is left out: limits have stopped it twice"))
        elif not current.captures(experiment):
            options = {"seed": (seed + place) % SEEDS} if has_noise else None
            record(experiment, current.rig, current.runs, options=options, watch=watch)
    if not _logs([*done, current]):
        cure = "see why in the run.json of each, then characterise anew"
        problem = "limits have stopped every run twice: there is nothing to identify from"
        raise ConfigError(problem, cure=cure, file=current.runs)


def _logs(rounds: Sequence[Round]) -> list[Path]:
    """Folders of all runs that were completed, in their order."""
    return [folder for each in rounds for folder in each.logs]


def _identify(
    rounds: Sequence[Round], request: Request, watch: Watch, *, ends: bool = False
) -> None:
    """Identify from all runs until now.

    Where this is the end, from all that there is to judge by, what the model may lack is tested,
    and the report is written.
    """
    folder = rounds[-1].identification
    problem = problem_of(SettingsRequest(request.config, {"model": request.model}), watch)
    logs = [folder / LOG_NAME for folder in _logs(rounds)]
    going_on = (folder / CHECKPOINT).exists()

    def is_last(result: Identification) -> bool:
        return ends or bool(_end(request, rounds, result.document))

    earlier = rounds[-2].as_earlier_fit if len(rounds) > 1 else None
    identification = fit(
        problem, logs, [], folder, watch, resume=going_on, examine=is_last, earlier=earlier
    )
    if identification.interrupted:
        raise KeyboardInterrupt
    if is_last(identification):
        make_folder(rounds[-1].root / "report")
        publish(identification, rounds[-1].root / "report", watch)
