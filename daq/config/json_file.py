"""JSON that a program wrote and somebody may have changed."""

import json
from pathlib import Path
from typing import Any

from daq.config.bounds import check_json, text_of
from daq.errors import ConfigError


def load(path: Path, kind: str, cure: str) -> dict[str, Any]:
    """Read a JSON object; ConfigError with the cure where it is unreadable, malformed or too large.

    kind: what the file should be, such as "run record".
    """
    try:
        text = text_of(path)
        check_json(text, path)
        content = json.loads(text)
    except OSError as error:
        problem = f"not a readable {kind} ({error.strerror})"
        raise ConfigError(problem, cure=cure, file=path) from None
    except json.JSONDecodeError as error:
        problem = f"not a readable {kind} ({error.msg})"
        raise ConfigError(
            problem, cure=cure, file=path, line=error.lineno, column=error.colno
        ) from None
    if not isinstance(content, dict):
        raise ConfigError(f"not a {kind}", cure=cure, file=path)
    return content
