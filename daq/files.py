"""Files and folders written for a user: whole or not at all, with the cure where it fails."""

import contextlib
import datetime
import hashlib
from pathlib import Path

from daq.errors import ConfigError, RunError


def write_whole(
    path: Path, content: str | bytes, cure: str = "name another place, or make room there"
) -> None:
    """Replace a file's content in one step. Raises RunError when the disk refuses."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = error.strerror
        if not path.parent.is_dir():
            reason = f"there is no folder {path.parent}, make it first"
        raise RunError(f"cannot be written: {reason}", cure=cure, file=path) from None


def require_target(path: Path, suffix: str) -> None:
    """Raise ConfigError where a file of a format, ``.mat``, cannot be meant to stand at a path."""
    if path.suffix.lower() not in ("", suffix):
        cure = f"name it {path.with_suffix(suffix).name}"
        raise ConfigError(f"a file of this format ends in {suffix}", cure=cure, file=path)
    if not path.parent.is_dir():
        problem = f"cannot be written: there is no folder {path.parent}, make it first"
        raise ConfigError(problem, cure="or choose another place with --out FILE", file=path)


def stamp(now: datetime.datetime | None = None) -> str:
    """A time, by default the present, with which names of folders begin, in UTC.

    >>> stamp(datetime.datetime(2026, 1, 31, 12, tzinfo=datetime.UTC))
    '20260131T120000Z'
    """
    return f"{now or datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}"


def digest(path: Path) -> str:
    """SHA-256 of a file's content, by which it is known again."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make_folder(
    folder: Path, exist_ok: bool = True, cure: str = "choose a folder with --out"
) -> None:
    """Make a folder and what leads to it; ConfigError with the cure when that is impossible.

    Raises FileExistsError where it must be new and is not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
    except OSError as error:
        is_file = isinstance(error, FileExistsError)
        if is_file and not exist_ok:
            raise
        reason = "File exists" if is_file else error.strerror
        raise ConfigError(f"cannot be created: {reason}", cure=cure, file=folder) from None
