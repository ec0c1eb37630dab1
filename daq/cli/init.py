"""``rig init``: a folder with an experiment, a rig and settings of an identification to change."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from daq.cli import terminal as console
from daq.config.schema import Schema
from daq.errors import ConfigError, RunError, suggestion
from daq.files import make_folder
from daq.lookup import schemas
from daq.lookup.shipped import shipped_experiments, shipped_rigs

_RIG, _SETTINGS = "rig.yaml", "identification.yaml"
_SETTINGS_HEAD = """\
# Settings of an identification, all of which may be left out:
#   rig identify RUN --config identification.yaml
# Keys behind a '#' show the default, or an example, of what else can be set.
"""
_ACTIVE = {"model": "actuator", "preset": "default"}


def init_command(folder: Path, protocol: str, rig: str, as_json: bool) -> None:
    """Write the files that are not there yet, and say what to do next."""
    experiment = f"{protocol}.yaml"
    texts = {
        experiment: _copy(shipped_experiments(), protocol, "protocol", "experiment"),
        _RIG: _copy(shipped_rigs(), rig, "rig", "rig"),
        _SETTINGS: settings_text(),
        **_companions(protocol),
    }
    make_folder(folder)
    written = [folder / name for name, text in texts.items() if _write_new(folder / name, text)]
    kept = [folder / name for name in texts if folder / name not in written]
    schemas.write_schemas(folder / schemas.FOLDER, console.report)
    if as_json:
        console.print_json({"written": list(map(str, written)), "kept": list(map(str, kept)),
                            "schemas": str(folder / schemas.FOLDER)})  # fmt: skip
        return
    for path in written:
        console.print_line(f"Written: {path}")
    console.print_line(f"Written: {folder / schemas.FOLDER}, by which editors check these files")
    for path in kept:
        console.print_line(f"Kept as it was: {path}")
    there = [] if folder.resolve() == Path.cwd() else [f"cd {folder}"]
    # An experiment without a validation run is mostly not for an identification.
    identify = f" --identify --config {_SETTINGS}" if "\nvalidation:" in texts[experiment] else ""
    console.print_next(
        *there,
        f"rig check {experiment} --rig {_RIG}",
        f"rig run {experiment} --rig {_RIG}{identify}",
    )


def settings_text() -> str:
    """A file of an identification's settings in which all but two stand as comments."""
    schema = schemas.documents({}, {})["identification"]
    items = sorted(schema["properties"].items(), key=lambda item: item[0] not in _ACTIVE)
    settings = "\n".join(_setting(name, item) for name, item in items)
    return f"{schemas.schema_comment('identification')}\n{_SETTINGS_HEAD}\n{settings}"


def _setting(name: str, item: Schema) -> str:
    value = _ACTIVE.get(name, item.get("default"))
    if "examples" in item:
        value = item["examples"][0]
    mark = "" if name in _ACTIVE else "#"
    return f"# {item['description']}\n{mark}{name}: {schemas.as_yaml(value)}\n"


def _copy(files: Mapping[str, Path], name: str, option: str, kind: str) -> str:
    """A shipped file's text, for a folder that has its schema in it."""
    shipped = {path.stem: path for path in files.values()}
    if name not in shipped:
        cure = suggestion(name, list(shipped))
        raise ConfigError(f"no {name!r} to begin with", cure=cure, key=f"--{option}")
    text = shipped[name].read_text(encoding="utf-8")
    return f"{schemas.schema_comment(kind)}\n{schemas.without_schema_comment(text)}"


def _companions(protocol: str) -> dict[str, str]:
    """Tables that a shipped experiment reads, which lie beside it under its name."""
    shipped = shipped_experiments()[f"{protocol}.yaml"]
    return {
        path.name: path.read_text(encoding="utf-8")
        for path in shipped.parent.glob(f"{protocol}.csv")
    }


def _write_new(path: Path, text: str) -> bool:
    """Whether the file was written; one that is there stays as it is."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return False
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror}") from None
    return True
