"""Commented files to begin with: an experiment, a rig and settings of an identification."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from daq.errors import ConfigError, RunError, suggestion
from daq.files import make_folder
from daq.lookup import schemas
from daq.lookup.rigs import load_rig
from daq.lookup.shipped import shipped_files
from daq.progress import Watch, ignore

RIG, SETTINGS = "rig.yaml", "identification.yaml"
DEFAULT_PROTOCOL = "prbs"
FIRST_EXPERIMENTS = ("still", "tenth")  # zero commands, and a tenth of the default's
_FIRST_LIMITS = "_tenth"  # ends the name of a shipped rig whose limits are for its first evening
_HEAD = """\
# Settings of an identification, all of which may be left out:
#   rig identify RUN --config identification.yaml
# Keys behind a '#' show the default, or an example, of what else can be set.
"""
_ACTIVE = {"model": "actuator", "preset": "default"}


@dataclass(frozen=True)
class Starter:
    """What lies in a folder to begin with.

    written, kept: files written, and files kept as they were. hardware: whether the rig begins with
    ``FIRST_EXPERIMENTS`` and limits for them. on_port: whether that hardware is on a port.
    validated: whether the experiment that was asked for has a validation run.
    """

    written: list[Path]
    kept: list[Path]
    hardware: bool
    on_port: bool
    validated: bool


def write_starter(folder: Path, protocol: str | None, rig: str, watch: Watch = ignore) -> Starter:
    """Write the files that are not there yet, and a folder of schemas.

    protocol: default prbs, on hardware none but ``FIRST_EXPERIMENTS``. Raises ConfigError for names
    of nothing shipped.
    """
    experiments, rigs = shipped_files("protocol"), shipped_files("backend")
    first_rig = f"{rig.removesuffix(_FIRST_LIMITS)}{_FIRST_LIMITS}"
    hardware = f"{first_rig}.yaml" in rigs
    names = list(FIRST_EXPERIMENTS) if hardware else []
    if protocol or not hardware:
        names.append(protocol or DEFAULT_PROTOCOL)
    texts = {f"{name}.yaml": _copy(experiments, name, "protocol", "experiment") for name in names}
    validated = "\nvalidation:" in texts[f"{names[-1]}.yaml"]
    # Tables that a shipped experiment reads lie beside it under its name.
    tables = [experiments[name].with_suffix(".csv") for name in texts]
    texts |= {path.name: path.read_text(encoding="utf-8") for path in tables if path.exists()}
    texts[RIG] = _copy(rigs, first_rig if hardware else rig, "rig", "rig")
    texts[SETTINGS] = settings_text()
    make_folder(folder, cure="name another folder")
    written = [folder / name for name, text in texts.items() if _write_new(folder / name, text)]
    kept = [folder / name for name in texts if folder / name not in written]
    schemas.write_schemas(folder / schemas.FOLDER, watch)
    on_port = hardware and hasattr(load_rig(str(rigs[f"{first_rig}.yaml"]))[0].options, "port")
    return Starter(written, kept, hardware, on_port, validated)


def settings_text() -> str:
    """A file of an identification's settings in which all but two stand as comments."""
    schema = schemas.documents({}, {}, {})["identification"]
    items = sorted(schema["properties"].items(), key=lambda item: item[0] not in _ACTIVE)
    settings = "\n".join(_setting(name, item) for name, item in items)
    return f"{schemas.schema_comment('identification')}\n{_HEAD}\n{settings}"


def _setting(name: str, item: schemas.Schema) -> str:
    value = item.get("examples", [_ACTIVE.get(name, item.get("default"))])[0]
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


def _write_new(path: Path, text: str) -> bool:
    """Whether the file was written; one that is there stays as it is."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return False
    except OSError as error:
        raise RunError(f"cannot be written: {error.strerror}", file=path) from None
    return True
