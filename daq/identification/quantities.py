"""Numbers in a file whose units a process model declares, such as ``fixed: {L_m: 0.5 mH}``."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from daq.config.units import converted
from daq.config.yaml_file import YamlFile
from daq.errors import Mistake
from sysid.problem.model import ProcessModel

File = TypeVar("File", bound=YamlFile)


def in_model_units(file: File, models: Sequence[ProcessModel]) -> tuple[File, list[Mistake]]:
    """The file with plain numbers for what its models declare, and what does not convert."""
    parameters = {p.name: p.unit for model in models for p in model.parameters}
    states = {s.name: s.unit for model in models for s in model.states}
    content, mistakes = dict(file.content), []
    for group, units in (("ranges", parameters), ("fixed", parameters), ("initial", states)):
        if isinstance(content.get(group), Mapping):
            content[group], wrong = _converted(file, group, content[group], units)
            mistakes += wrong
    return dataclasses.replace(file, content=content), mistakes


def _converted(
    file: YamlFile, group: str, given: Mapping[str, Any], units: Mapping[str, str]
) -> tuple[dict[str, Any], list[Mistake]]:
    numbers, mistakes = dict(given), []
    for name, value in given.items():
        if name not in units:
            continue
        try:
            numbers[name] = (
                [converted(end, units[name]) for end in value]
                if isinstance(value, list)
                else converted(value, units[name])
            )
        except ValueError as error:
            mistakes.append(file.mistake((group, name), f"{error}; found {value!r}"))
            del numbers[name]  # said once
    return numbers, mistakes
