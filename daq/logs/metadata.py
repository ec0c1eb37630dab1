"""What is noted of a run, in a file of its folder that people may edit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from daq.config import check, yaml_file
from daq.config.metadata import Metadata
from daq.errors import ConfigError
from daq.files import write_whole

METADATA_NAME = "metadata.yaml"


def read_metadata(folder: Path) -> Metadata:
    """What is noted of the run in a folder. Raises ConfigError at what is wrong in its file."""
    path = folder / METADATA_NAME
    if not path.exists():
        return Metadata()
    return check.validate(yaml_file.load(path), Metadata)


def write_metadata(folder: Path, metadata: Metadata) -> None:
    """Note it in the folder; nothing to note leaves no file. Raises RunError."""
    path = folder / METADATA_NAME
    if metadata.content:
        write_whole(path, yaml.safe_dump(metadata.content, sort_keys=False, allow_unicode=True))
    else:
        path.unlink(missing_ok=True)


def amended(metadata: Metadata, changes: Mapping[str, Any], option: str = "--note") -> Metadata:
    """Metadata with other values, of which an option has told. Raises ConfigError."""
    try:
        return metadata.amended(changes)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        problem = first["msg"].removeprefix("Value error, ")
        cure = "" if option == "--tag" else "write KEY=VALUE, such as operator=Ann, or text"
        raise ConfigError(": ".join(filter(None, (key, problem))), cure=cure, key=option) from None
