"""A question with all that it names, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from daq.config import check
from daq.config.question import Question
from daq.config.rig import RigConfig
from daq.config.yaml_file import TypedSettings, YamlFile
from daq.designs.bench import PlantBench
from daq.designs.families import ProtocolFamily, families_of
from daq.designs.knowledge import noise_of, prior_of, require_calibrated
from daq.errors import ConfigError
from daq.experiment import RunFrame, Shaft
from daq.hal import Device, Simulation
from daq.identification import stages
from daq.identification.request import SettingsRequest
from daq.identification.settings import Problem, problems_of
from daq.logs.encoder import SPEED
from daq.logs.recording import load as load_recording
from daq.logs.recording import log_path
from daq.lookup.models import DEFAULT_MODEL, find_model, name_parts
from daq.lookup.rigs import DEFAULT_RIG, load_rig
from daq.progress import Note, Watch, ignore
from sysid import ModelError, ProcessModel, SearchSpace
from sysid.experiments import Prior

_ITS_OWN = "turns", "limits"  # options of a model: a plant has ends, and a question winds it up
_TURNS = 5.0  # of a cable, where a question does not say how many to wind


@dataclass(frozen=True)
class Setup:
    """A question with all that it names, checked before anything is computed."""

    file: TypedSettings
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


def set_up(file: TypedSettings, watch: Watch = ignore) -> Setup:
    """A question and what it names. Raises ConfigError that names file, line, key and cure."""
    question = check.validate(file, Question)
    if question.structures:
        problem = "one structure is identified here; rig design tells several apart"
        raise file.error(("structures",), problem)
    return _set_up_each(file, question, [None], watch)[0]


def set_up_structures(file: TypedSettings, watch: Watch = ignore) -> dict[str, Setup]:
    """The same for each of the structures that a question names, by their names."""
    question = check.validate(file, Question)
    refused = {"targets": question.targets, "precision": question.precision}
    for key, asked_for in refused.items():
        if asked_for:
            problem = "runs that tell structures apart are not chosen by their intervals"
            raise file.error((key,), problem, "leave it out, or structures")
    names = structure_names(file, question)
    setups = _set_up_each(file, question, list(names.values()), watch)
    return dict(zip(names, setups, strict=True))


def structure_names(file: TypedSettings, question: Question) -> dict[str, str]:
    """Names of the models that a question names as structures, by what they are called.

    Raises ConfigError for fewer than two.
    """
    structures = question.structures or []
    if isinstance(structures, list):
        names = {name: name for name in structures}
    else:
        model = beside(file, "model", question.model) or DEFAULT_MODEL
        colon = "," if name_parts(model)[2] else ":"
        names = {"": f"{model}{colon}"}
        for option, choices in structures.items():
            names = {
                ", ".join(filter(None, [name, f"{option} {choice}"])): f"{start}{option}={choice},"
                for name, start in names.items()
                for choice in choices
            }
        names = {name: model.rstrip(",") for name, model in names.items()}
    if len(names) < 2:
        problem = "two at least are told apart"
        cure = "write structures: {hysteresis: [bouc-wen, dahl]}, or a list of models"
        raise file.error(("structures",), problem, cure)
    return names


def _set_up_each(
    file: TypedSettings, question: Question, names: Sequence[str | None], watch: Watch
) -> list[Setup]:
    """A question's setup for each of several models, None for the one that it names."""
    rig_name = beside(file, "rig", question.rig) or DEFAULT_RIG
    rig, device = load_rig(rig_name, watch=watch)
    config = beside(file, "config", question.config)
    result = _earlier(file, question)
    model, record = beside(file, "model", question.model), None
    if model is None and result is not None:
        model, record = result.content.get("model"), result.path
    models = [name or model for name in names]
    options = {"model": model} if names == [None] else {}
    problems = problems_of(SettingsRequest(config, options), models, watch, record)
    turns = question.turns
    if turns is None:
        turns = _TURNS if rig.limits.winding is not None else 0.0
    frame = _frame(file, question, rig, _shaft(rig, problems[0].model, turns))
    families = families_of(file, question, frame, turns)
    log = beside(file, "log", question.log)
    recording = None if log is None else load_recording(log_path(Path(log)))
    if recording is not None:
        require_calibrated(Path(str(log)), recording)
    first, rate = problems[0].model, question.rate
    noise = noise_of(file, question.noise, rig, first, rate, recording)
    if recording is None and not question.noise:
        units = {s.name: s.unit for s in first.inputs} | {s.name: s.unit for s in first.outputs}
        shown = ", ".join(f"{name} {size:.2g} {units[name]}" for name, size in noise.items())
        cure = "rig design --log RUN takes a calibration's"
        watch(Note("note", f"noise is assumed: {shown}; {cure}"))
    timed, margin = SPEED not in question.noise, question.margin / 100.0
    setups = []
    for name, problem in zip(names, problems, strict=True):
        parts = "" if name is None else name_parts(name)[2]
        plant = _plant(file, question, rig_name, device, turns, parts)
        space = problem.space
        earlier = result if name is None or _is_of(result, problem) else None
        identified = earlier is not None
        bench = PlantBench(problem.model, plant, rig, turns, margin, noise, timed, identified)
        setups.append(
            Setup(
                file, question, rig_name, rig, problem, space, bench, families,
                prior_of(space, earlier), noise,
            )
        )  # fmt: skip
    return setups


def _is_of(result: YamlFile | None, problem: Problem) -> bool:
    """Whether a result is of a problem's model."""
    return result is not None and result.content.get("model") == problem.model_name


def _earlier(file: TypedSettings, question: Question) -> YamlFile | None:
    """The result of an earlier identification that a question names."""
    path = beside(file, "parameters", question.parameters)
    return None if path is None else stages.load([Path(path)])[0]


def beside(file: TypedSettings, key: str, name: str | None) -> str | None:
    """A file that a question names, from its folder; typed and shipped names as they are."""
    if not name or key in file.typed:
        return name or None
    beside = file.path.parent / name
    return str(beside) if beside.exists() else name


def _shaft(rig: RigConfig, model: ProcessModel, turns: float) -> Shaft | None:
    """What loops may do with a rig's shaft: nothing, where no speed is too fast."""
    limits = rig.limits
    if limits.speed is None:
        return None
    endless = turns == 0.0 and limits.winding is None and limits.travel is None
    between = "torque" in model.output_names
    constant = rig.sensors.torque.motor_constant
    return Shaft(limits.speed, endless, "between" if between else "load", constant)


def _frame(file: YamlFile, question: Question, rig: RigConfig, shaft: Shaft | None) -> RunFrame:
    n_samples = round(question.seconds * question.rate)
    if n_samples < 2:
        problem = f"{question.seconds:g} s at {question.rate:g} Hz makes {n_samples} samples"
        raise file.error(("run",), problem, "make it longer")
    if question.seconds > question.time:
        problem = f"a run of {question.seconds:g} s is longer than the {question.time:g} s of all"
        raise file.error(("run",), problem, "make it shorter, or give more time")
    ranges = rig.limits.command
    return RunFrame(n_samples, question.rate, ranges.motor, ranges.brake, shaft)


def _plant(
    file: TypedSettings, question: Question, rig: str, device: Device, turns: float, parts: str
) -> ProcessModel:
    """The whole plant, as a question names it or as a simulated rig has it.

    parts: options of a structure, which are the plant's as well.
    """
    if question.plant is not None:
        folder = None if "plant" in file.typed else file.path.parent
        name = question.plant
        if parts:
            name += ("," if name_parts(name)[2] else ":") + parts
        try:
            return find_model(name, folder)
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
        if parts:
            options = [option.split("=", 1) for option in parts.split(",")]
            values = {key: yaml.safe_load(value) for key, value in options if key not in _ITS_OWN}
            device = load_rig(rig, {"plant": values})[1]
            assert isinstance(device, Simulation)
        plant: ProcessModel = device.plant_model(turns)
    except ModelError as error:
        raise ConfigError(str(error), file=rig) from None
    return plant
