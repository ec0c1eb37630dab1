"""Data sheets on disk: ranges and fixed values for parameters of which nothing else is said."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.config import check, yaml_file
from daq.config.identification import DatasheetEntry, IdentificationConfig
from daq.config.yaml_file import YamlFile
from daq.errors import suggestion
from daq.identification.records import unit_factor
from sysid import ModelError, ProcessModel, SearchSpace


@dataclass(frozen=True)
class Datasheet:
    """A checked file of entries by parameter."""

    file: YamlFile
    entries: dict[str, DatasheetEntry]


def load(path: Path) -> Datasheet:
    """Read a data sheet; ConfigError names line, key and cure."""
    file = yaml_file.load(path)
    mistakes = [
        mistake
        for name, content in file.content.items()
        for mistake in check.mistakes(file, DatasheetEntry, content, (str(name),))
    ]
    check.refuse([*file.repeated, *mistakes])
    entries = {
        str(name): DatasheetEntry.model_validate(content) for name, content in file.content.items()
    }
    return Datasheet(file, entries)


def check_names(sheets: Sequence[Datasheet], models: Sequence[ProcessModel]) -> None:
    """Raise ConfigError for an entry that no model has a parameter for, or that stands twice."""
    parameters = list(dict.fromkeys(name for model in models for name in model.parameter_names))
    places: dict[str, str] = {}
    for sheet in sheets:
        for name in sheet.entries:
            if name not in parameters:
                names = " or ".join(dict.fromkeys(model.name for model in models))
                raise sheet.file.error(
                    (name,), f"model {names} has no such parameter; {suggestion(name, parameters)}"
                )
            if name in places:
                raise sheet.file.error((name,), f"also in {places[name]}; keep one")
            places[name] = sheet.file.where((name,))


def under(
    settings: IdentificationConfig, sheets: Sequence[Datasheet], model: ProcessModel
) -> tuple[IdentificationConfig, dict[str, str]]:
    """Settings completed by data sheets, and the line that each of their values comes from.

    What the settings say of a parameter goes before. Raises ConfigError for a value that is
    physically impossible, or a unit that does not convert.
    """
    ranges, fixed, sources = dict(settings.ranges), dict(settings.fixed), {}
    settled = {*ranges, *fixed, *settings.tied}
    for sheet in sheets:
        for name, entry in sheet.entries.items():
            if name in settled or name not in model.parameter_names:
                continue
            unit = model.parameter(name).unit
            factor = unit_factor(sheet.file, (name, "unit"), entry.unit, unit)
            try:
                if entry.fixed:
                    assert entry.value is not None
                    fixed[name] = factor * entry.value
                    model.with_parameters(**{name: {"nominal": fixed[name], "fixed": True}})
                else:
                    ranges[name] = entry.ends(factor)
                    SearchSpace.of(model, {name: ranges[name]})
            except ModelError as error:
                raise sheet.file.error((name,), str(error)) from None
            place = sheet.file.line((name,))
            sources[name] = f"{place} ({entry.source})" if entry.source else place
    return settings.model_copy(update={"ranges": ranges, "fixed": fixed}), sources
