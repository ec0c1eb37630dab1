"""Families of runs from the protocols' own settings, and the experiments that their files hold."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from daq.config.question import Question
from daq.config.yaml_file import YamlFile
from daq.designs.closed_loop import feedback_of
from daq.errors import ConfigError
from daq.experiment import ClosedLoop, Experiment, Family, RunFrame
from daq.hal import FloatArray
from daq.lookup.classes import find_class
from daq.plugins import installed
from daq.run.protocol import plan_of
from sysid import Excitation, Feedback, Setting

_DIGITS = 4  # of a setting that a design chooses
_ROUNDING = 12  # digits of what follows from it: times stay whole numbers of samples


@dataclass(frozen=True)
class ProtocolFamily:
    """A protocol's family, and the keys that all its experiments have in common."""

    protocol: type[Experiment]
    family: Family
    common: Mapping[str, Any]

    def content(self, settings: Mapping[str, float]) -> dict[str, Any]:
        """The content of an experiment's file at settings by name."""
        short = {name: float(f"{value:.{_DIGITS}g}") for name, value in settings.items()}
        for name, free in self.family.free.items():
            if free.whole:
                short[name] = settings[name]
        content: dict[str, Any] = {**self.common, **_rounded(self.family.content(short))}
        return content

    def commands(self, settings: Mapping[str, float]) -> FloatArray | Feedback:
        """The commands of the run, (n_samples, 2) [V], or what makes them of the samples."""
        experiment = self.protocol.model_validate(self.content(settings))
        planned = plan_of(experiment)
        if isinstance(experiment, ClosedLoop):
            return feedback_of(experiment, planned)
        assert planned.commands is not None
        return planned.commands

    def excitation(self) -> Excitation:
        """The same for a search."""
        name, rate = self.common["protocol"], self.common["sample_rate"]
        free = {key: Setting(**asdict(setting)) for key, setting in self.family.free.items()}
        return Excitation(name, free, self.commands, 1.0 / rate)


def families_of(
    file: YamlFile, question: Question, frame: RunFrame, turns: float
) -> dict[str, ProtocolFamily]:
    """Families of the protocols that a question names, or of all that have one, by name.

    Raises ConfigError for a named one that has none.
    """
    families = {}
    for k, name in enumerate(question.protocols or installed("protocol")):
        try:
            protocol = find_class("protocol", name, file.path.parent)
        except ConfigError as error:
            if question.protocols:
                raise ConfigError.of(file.blamed(("protocols", k), error)) from None
            continue
        family = protocol.family(frame)
        if family is not None:
            common = {
                "protocol": name,
                "sample_rate": frame.sample_rate,
                "calibration": {"samples": question.calibration},
                "homing": {"turns": turns},
            }
            families[name] = ProtocolFamily(protocol, family, common)
        elif question.protocols:
            problem = (
                f"protocol {name} has no settings that a design may choose on this rig, in runs of "
                f"{frame.seconds:g} s"
            )
            raise file.error(
                ("protocols", k), problem, f"known are {', '.join(with_family(frame))}"
            )
    return families


def with_family(frame: RunFrame) -> Sequence[str]:
    """Names of the installed protocols with settings that a design may choose."""
    names = []
    for name in installed("protocol"):
        with contextlib.suppress(ConfigError):  # one that does not load
            protocol = find_class("protocol", name, Path())
            if protocol.family(frame) is not None:
                names.append(name)
    return names


def _rounded(content: Any) -> Any:
    """Content of a file whose numbers have no more digits than they need."""
    if isinstance(content, Mapping):
        return {key: _rounded(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_rounded(value) for value in content]
    return float(f"{content:.{_ROUNDING}g}") if isinstance(content, float) else content
