"""From a question to a design: what to know, on which rig, from what is known already."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.config import check, yaml_file
from daq.config.question import Question
from daq.config.rig import RigConfig
from daq.config.yaml_file import TypedSettings, YamlFile
from daq.designs.bench import PlantBench
from daq.designs.families import ProtocolFamily, families_of
from daq.designs.knowledge import noise_of, prior_of, require_calibrated
from daq.designs.pictures import draw_design
from daq.designs.result import DesignResult, PlannedRun
from daq.documents import plain
from daq.errors import ConfigError
from daq.experiment import RunFrame
from daq.files import make_folder, write_whole
from daq.hal import Device, Simulation
from daq.identification import stages
from daq.identification.fit import check_writable
from daq.identification.request import SettingsRequest
from daq.identification.settings import Problem, problem_of
from daq.logs.encoder import SPEED
from daq.logs.recording import load as load_recording
from daq.logs.recording import log_path
from daq.lookup.models import find_model
from daq.lookup.rigs import DEFAULT_RIG, load_rig
from daq.lookup.schemas import schema_comment
from daq.progress import Note, Progress, Watch, ignore
from sysid import Design, ModelError, ProcessModel, SearchSpace
from sysid import design as choose_runs
from sysid.experiments import Prior

_TURNS = 5.0  # of a cable, where a question does not say how many to wind
_ALL = 2.0  # simulated runs for each one that a search asks for: what passes a limit is tried again
DATA, FIGURE = "design.json", "design.png"


@dataclass(frozen=True)
class Setup:
    """A question with all that it names, checked before anything is computed."""

    file: YamlFile
    question: Question
    rig_name: str
    rig: RigConfig
    problem: Problem
    space: SearchSpace
    bench: PlantBench
    families: Mapping[str, ProtocolFamily]
    prior: Prior
    noise: Mapping[str, float]

    @property
    def targets(self) -> dict[str, float]:
        """Half widths that are wanted, in parts of the values, by quantity."""
        return {name: percent / 100.0 for name, percent in self.question.targets.items()}


def design(
    question: str | Path | None = None,
    out: str | Path | None = None,
    *,
    watch: Watch = ignore,
    **settings: Any,
) -> DesignResult:
    """Design runs for a rig, and write their files; nothing is energised.

    question: a file as for ``rig design``; settings: its keys, which go before it. out: the folder
    of the files, by default a new one under ``designs``. Raises ConfigError.

    >>> from daq import design
    >>> quick = {"candidates": 8, "generations": 0, "draws": 1, "checks": 2}
    >>> result = design(precision="5 %", time="2.5 s", **quick)
    >>> [run.file.name for run in result.runs]
    ['designed-1.yaml', 'designed-2.yaml']
    """
    file = None if question is None else Path(question)
    return design_files(file, settings, (), None if out is None else Path(out), watch)


def design_files(
    question: Path | None,
    options: Mapping[str, Any],
    settings: Sequence[str],
    out: Path | None,
    watch: Watch = ignore,
) -> DesignResult:
    """Design runs as ``rig design`` does.

    options: keys of the question by name, None for those not given; settings: any others, as
    ``key=value``. Raises ConfigError.
    """
    written = None if question is None else yaml_file.load(question)
    if written is not None:
        check.refuse_other_kind(written, "a design's question")
    typed = {key: value for key, value in options.items() if value is not None}
    setup = set_up(TypedSettings.of(typed, settings, written), watch)
    folder = out or Path("designs") / _stamp()
    check_writable(folder)
    return write(setup, choose(setup, watch), folder)


def set_up(file: TypedSettings, watch: Watch = ignore) -> Setup:
    """A question and what it names. Raises ConfigError that names file, line, key and cure."""
    question = check.validate(file, Question)
    rig_name = _beside(file, "rig", question.rig) or DEFAULT_RIG
    rig, device = load_rig(rig_name, watch=watch)
    config = _beside(file, "config", question.config)
    result = _earlier(file, question)
    model, record = _beside(file, "model", question.model), None
    if model is None and result is not None:
        model, record = result.content.get("model"), result.path
    problem = problem_of(SettingsRequest(config, {"model": model}), watch, record)
    turns = question.turns
    if turns is None:
        turns = _TURNS if rig.limits.winding is not None else 0.0
    frame = _frame(file, question, rig)
    families = families_of(file, question, frame, turns)
    space = _space(file, problem)
    log = _beside(file, "log", question.log)
    recording = None if log is None else load_recording(log_path(Path(log)))
    if recording is not None:
        require_calibrated(Path(str(log)), recording)
    noise = noise_of(file, question.noise, rig, problem.model, question.sample_rate, recording)
    if recording is None and not question.noise:
        shown = ", ".join(f"{name} {deviation:.2g}" for name, deviation in noise.items())
        watch(Note("note", f"noise is assumed: {shown}; --log RUN takes a calibration's"))
    plant = _plant(file, question, rig_name, device, turns)
    timed = SPEED not in question.noise
    bench = PlantBench(problem.model, plant, rig, turns, question.margin / 100.0, noise, timed)
    prior = prior_of(space, result)
    return Setup(file, question, rig_name, rig, problem, space, bench, families, prior, noise)


def choose(setup: Setup, watch: Watch = ignore) -> Design:
    """The runs that tell most. Raises ConfigError where none can be made."""
    question, settings, given = setup.question, setup.problem.settings, setup.problem.given
    expected = question.candidates + _ALL * question.generations * question.offspring

    def report(attempts: int, kept: int) -> None:
        status = f"{attempts} runs simulated, {kept} within the limits"
        watch(Progress("Choosing runs", min(attempts, expected), expected, status))

    try:
        return choose_runs(
            setup.problem.model,
            [family.excitation() for family in setup.families.values()],
            noise=setup.noise,
            runs=question.most_runs,
            targets=setup.targets,
            precision=None if question.precision is None else question.precision / 100.0,
            criterion=question.criterion,
            prior=setup.prior,
            ranges=settings.ranges,
            fixed={**settings.fixed, **(given.values if given else {})},
            tied=settings.tied,
            bench=setup.bench,
            draws=question.draws,
            checks=question.checks,
            candidates=question.candidates,
            generations=question.generations,
            offspring=question.offspring,
            accuracy=settings.accuracy,
            seed=question.seed,
            watch=report,
        )
    except ModelError as error:
        key = ("targets",) if setup.targets else ("protocols",)
        raise setup.file.error(key, str(error)) from None


def write(setup: Setup, chosen: Design, folder: Path) -> DesignResult:
    """A design's experiments, its figure and its document, in a folder that may be new.

    The document is the last of them. Raises RunError where the disk refuses.
    """
    make_folder(folder)
    vectors = setup.space.full(
        setup.prior.draws(
            setup.space, setup.question.checks, np.random.default_rng(setup.question.seed)
        )
    )
    runs = []
    for k, run in enumerate(chosen.runs, 1):
        path = folder / f"designed-{k}.yaml"
        content = setup.families[run.excitation].content(run.settings)
        write_whole(path, _experiment_text(content, setup.rig_name, k, len(chosen.runs)))
        signals = setup.bench.signals(run.inputs, run.dt, vectors)
        runs.append(PlannedRun(path, run.excitation, run.settings, run.inputs, signals, run.dt))
    result = DesignResult(
        setup.question, setup.problem.model, setup.problem.model_name, setup.rig_name, chosen,
        tuple(runs), setup.noise, folder, folder / FIGURE,
    )  # fmt: skip
    draw_design(result, setup.rig)
    write_whole(folder / DATA, json.dumps(plain(result.document), indent=1) + "\n")
    return result


def _experiment_text(content: Mapping[str, Any], rig: str, number: int, count: int) -> str:
    head = f"{schema_comment('experiment')}\n# Run {number} of {count} of a design by rig design.\n"
    file = {"protocol": content["protocol"], "rig": rig, **content}
    return head + yaml.safe_dump(file, sort_keys=False, default_flow_style=None)


def _earlier(file: TypedSettings, question: Question) -> YamlFile | None:
    """The result of an earlier identification that a question names."""
    path = _beside(file, "parameters", question.parameters)
    return None if path is None else stages.load([Path(path)])[0]


def _beside(file: TypedSettings, key: str, name: str | None) -> str | None:
    """A file that a question names, from its folder; typed and shipped names as they are."""
    if not name or key in file.typed:
        return name or None
    beside = file.path.parent / name
    return str(beside) if beside.exists() else name


def _frame(file: YamlFile, question: Question, rig: RigConfig) -> RunFrame:
    n_samples = round(question.seconds * question.sample_rate)
    if n_samples < 2:
        problem = f"{question.seconds:g} s at {question.sample_rate:g} Hz makes {n_samples} samples"
        raise file.error(("run",), problem, "make it longer")
    if question.seconds > question.time:
        problem = f"a run of {question.seconds:g} s is longer than the {question.time:g} s of all"
        raise file.error(("run",), problem, "make it shorter, or give more time")
    ranges = rig.limits.command
    return RunFrame(n_samples, question.sample_rate, ranges.motor, ranges.brake)


def _space(file: YamlFile, problem: Problem) -> SearchSpace:
    settings, given = problem.settings, problem.given
    fixed = {**settings.fixed, **(given.values if given else {})}
    return SearchSpace.of(problem.model, settings.ranges, fixed, tied=settings.tied)


def _plant(
    file: TypedSettings, question: Question, rig: str, device: Device, turns: float
) -> ProcessModel:
    """The whole plant, as a question names it or as a simulated rig has it."""
    if question.plant is not None:
        folder = None if "plant" in file.typed else file.path.parent
        try:
            return find_model(question.plant, folder)
        except ConfigError as error:
            raise ConfigError.of(file.blamed(("plant",), error)) from None
    if not isinstance(device, Simulation):
        raise ConfigError(
            "nothing tells what hangs on this rig, and so what a run would do",
            cure="name a model of the whole plant, such as --plant "
            f"actuator:load=pulley,limits=true,turns={turns:g}",
            file=rig,
        )
    try:
        plant: ProcessModel = device.plant_model(turns)
    except ModelError as error:
        raise ConfigError(str(error), file=rig) from None
    return plant


def _stamp() -> str:
    now = datetime.datetime.now(datetime.UTC)
    return f"{now:%Y%m%dT%H%M%SZ}"
