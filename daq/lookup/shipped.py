"""YAML files that lie beside the installed protocols and backends."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from daq.config.yaml_file import nearest_file
from daq.errors import USER_CODE_ERRORS, ConfigError
from daq.plugins import Kind, installed
from daq.progress import Note, Watch, ignore


def shipped_files(kind: Kind) -> dict[str, Path]:
    """Experiments beside the installed protocols, or rigs beside the backends, by file name."""
    packages = dict.fromkeys(point.module.rpartition(".")[0] for point in installed(kind).values())
    folders = [Path(folder) for package in packages for folder in _folders(package)]
    paths = [path for folder in folders for path in folder.glob("*.yaml")]
    return {path.name: path for path in sorted(paths, key=lambda path: path.name)}


def find_file(kind: Kind, name: str, watch: Watch = ignore) -> Path:
    """A file in the working folder, or a shipped one under its bare name; ConfigError for none."""
    path = Path(name)
    if path.exists():
        return path
    shipped, is_bare = shipped_files(kind), path.name == name
    if is_bare:
        for candidate in [name] if path.suffix else [name, f"{name}.yaml"]:
            if Path(candidate).exists():
                return Path(candidate)
            if candidate in shipped:
                watch(Note("detail", f"{name}: the shipped {shipped[candidate]}"))
                return shipped[candidate]
    cure = nearest_file(path, list(shipped) if is_bare else [])
    cure = cure or f"check its name, or use a shipped one: {', '.join(shipped)}"
    raise ConfigError("there is no such file", cure=cure, file=name)


def _folders(package: str) -> Sequence[str]:
    """Where a package lies; nowhere for a lone module, and for one whose parent does not import."""
    try:
        spec = importlib.util.find_spec(package) if package else None
    except USER_CODE_ERRORS:
        return ()
    return (spec and spec.submodule_search_locations) or ()
