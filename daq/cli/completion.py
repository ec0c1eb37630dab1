"""What the shell offers for a value when Tab is pressed (see ``rig --install-completion``)."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

Offer = tuple[str, str]  # a value and what it is
Kind = Literal["protocol", "backend"]

_FIRST = 4096  # characters of a file that say what kind it is


def experiments(incomplete: str) -> list[Offer]:
    """Shipped experiments, and YAML files here that name a protocol."""
    local = _local(incomplete, ".yaml", "protocol:")
    return _matching(incomplete, [*_shipped("protocol"), *local])


def rigs(incomplete: str) -> list[Offer]:
    """Shipped rigs, and YAML files here that name a backend or have its options."""
    local = _local(incomplete, ".yaml", "backend:", "options:")
    return _matching(incomplete, [*_shipped("backend"), *local])


def rig_names(incomplete: str) -> list[Offer]:
    """Shipped rigs by name."""
    return _matching(incomplete, _stems("backend"))


def protocols(incomplete: str) -> list[Offer]:
    """Shipped experiments by protocol."""
    return _matching(incomplete, _stems("protocol"))


def models(incomplete: str) -> list[Offer]:
    """Installed models, and Python files here."""
    from daq.plugins import installed

    names = [(name, point.value) for name, point in installed("model").items()]
    return _matching(incomplete, [*names, *_local(incomplete, ".py", "")])


def presets(incomplete: str) -> list[Offer]:
    """Presets of the search."""
    from typing import get_args

    from daq.config.identification import Preset

    return _matching(incomplete, [(name, "") for name in get_args(Preset)])


def _matching(incomplete: str, offers: Iterable[Offer]) -> list[Offer]:
    # What stands here goes before what is shipped by the same name.
    texts = {name: text for name, text in offers if name.startswith(incomplete)}
    return list(texts.items())


def _stems(kind: Kind) -> Iterator[Offer]:
    return ((name.removesuffix(".yaml"), text) for name, text in _shipped(kind))


def _shipped(kind: Kind) -> Iterator[Offer]:
    from daq.lookup.shipped import shipped_files

    return ((name, _about(path)) for name, path in shipped_files(kind).items())


def _local(incomplete: str, suffix: str, *keys: str) -> Iterator[Offer]:
    """Files of a kind that have one of the keys, and folders, in the folder that is being typed."""
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield f"{path.as_posix()}/", "folder"
        elif path.suffix == suffix and any(key in _beginning(path) for key in keys):
            yield path.as_posix(), _about(path)


def _about(path: Path) -> str:
    """The first comment of a file that is meant for people."""
    comments = (line[1:].strip() for line in _beginning(path).splitlines() if line[:1] == "#")
    return next((text for text in comments if not text.startswith("yaml-language-server")), "")


def _beginning(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            return file.read(_FIRST)
    except (OSError, UnicodeDecodeError):
        return ""
