"""Data sheets on disk: ranges and fixed values for parameters of which nothing else is said."""

from collections.abc import Sequence
from pathlib import Path

from daq.config import check, yaml_file
from daq.config.identification import DatasheetEntry, IdentificationConfig
from daq.config.yaml_file import YamlFile
from daq.errors import suggestion
from daq.identification.foreign import unit_factor
from sysid import ModelError, ProcessModel, SearchSpace

Entries = dict[str, tuple[YamlFile, DatasheetEntry]]  # by parameter, with the file they stand in


def load(paths: Sequence[Path], models: Sequence[ProcessModel]) -> Entries:
    """Read data sheets; ConfigError where an entry is wrong, stands twice or is no parameter's."""
    sheets = [(file, _checked(file)) for file in map(yaml_file.load, paths)]
    parameters = list(dict.fromkeys(name for model in models for name in model.parameter_names))
    entries: Entries = {}
    for file, sheet in sheets:
        for name, entry in sheet.items():
            if name not in parameters:
                names = " or ".join(dict.fromkeys(model.name for model in models))
                hint = suggestion(name, parameters)
                raise file.error((name,), f"model {names} has no such parameter; {hint}")
            if name in entries:
                place = entries[name][0].where((name,))
                raise file.error((name,), f"also in {place}; keep one")
            entries[name] = file, entry
    return entries


def _checked(file: YamlFile) -> dict[str, DatasheetEntry]:
    mistakes = list(file.repeated)
    for name, content in file.content.items():
        mistakes += check.mistakes(file, DatasheetEntry, content, (str(name),))
    check.refuse(mistakes)
    return {str(name): DatasheetEntry.model_validate(e) for name, e in file.content.items()}


def under(
    settings: IdentificationConfig, entries: Entries, model: ProcessModel
) -> tuple[IdentificationConfig, dict[str, str]]:
    """Settings completed by data sheets, and the line that each of their values comes from.

    What the settings say of a parameter goes before. Raises ConfigError for a value that is
    physically impossible, or a unit that does not convert.
    """
    ranges, fixed, sources = dict(settings.ranges), dict(settings.fixed), {}
    settled = {*ranges, *fixed, *settings.tied}
    for name, (file, entry) in entries.items():
        if name in settled or name not in model.parameter_names:
            continue
        factor = unit_factor(file, (name, "unit"), entry.unit, model.parameter(name).unit)
        try:
            if entry.fixed:
                assert entry.value is not None
                fixed[name] = factor * entry.value
                model.with_parameters(**{name: {"nominal": fixed[name], "fixed": True}})
            else:
                ranges[name] = entry.ends(factor)
                SearchSpace.of(model, {name: ranges[name]})
        except ModelError as error:
            raise file.error((name,), str(error)) from None
        place = file.line((name,))
        sources[name] = f"{place} ({entry.source})" if entry.source else place
    return settings.model_copy(update={"ranges": ranges, "fixed": fixed}), sources
