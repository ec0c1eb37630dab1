"""The state of a search in a file, from which it goes on to the bit.

A checkpoint is a NumPy archive: the arrays of the state, and JSON for all else. Beside the state
it holds the search's origin, in words and hashes, so that it is never continued with other data,
settings or equations.
"""

import hashlib
import json
import os
import time
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sysid.engine.compiler import fingerprint
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel

FORMAT = 1
INTERVAL = 0.5  # s between two writings

State = dict[str, Any]


def origin(
    model: ProcessModel, records: Sequence[Dataset], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Origin of a search: its model, records and settings."""
    signals = repr((model.states, model.inputs, model.outputs, model.parameters))
    origin = {
        "model": {
            "name": model.name,
            "signals and parameters": _hash(signals.encode()),
            "equations": fingerprint(model),
        },
        "records": [
            {
                "name": record.name,
                "samples": record.n_samples,
                "sample time": record.dt,
                "values": _hash(record.inputs.tobytes() + record.outputs.tobytes()),
            }
            for record in records
        ],
        "settings": dict(settings),
    }
    plain: dict[str, Any] = json.loads(json.dumps(origin, default=float))
    return plain


class Checkpoint:
    """Writes states to a file, whole or not at all, and not more often than makes sense.

    A first writing that fails raises ModelError; later ones only warn, lest the search be lost.
    """

    def __init__(self, path: Path, begun_with: Mapping[str, Any]) -> None:
        self.path = path
        self.begun_with = begun_with
        self._written: float | None = None
        self._pending: State | None = None

    def save(self, state: State) -> None:
        """Keep a state; write it if the last writing was a while ago."""
        self._pending = state
        if self._written is None or time.perf_counter() - self._written >= INTERVAL:
            self.flush()

    def flush(self) -> None:
        """Write the last state, unless that has been done."""
        if self._pending is None:
            return
        arrays: dict[str, Any] = {}
        state = _packed(self._pending, arrays)
        content = {"format": FORMAT, "begun with": self.begun_with, "state": state}
        arrays["json"] = np.array(json.dumps(content))
        temporary = self.path.with_name(f"{self.path.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as file:
                np.savez(file, **arrays)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self.path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            problem = f"{self.path}: the checkpoint cannot be written: {error.strerror}"
            if self._written is None:
                raise ModelError(problem) from None
            warnings.warn(problem, stacklevel=2)
        self._pending = None
        self._written = time.perf_counter()


def load(path: Path, begun_with: Mapping[str, Any]) -> State:
    """The state in a checkpoint; ModelError if there is none, or of a search of another origin."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            content = json.loads(str(archive["json"]))
            if content["format"] != FORMAT:
                raise ModelError(
                    f"{path}: a checkpoint of another version of this program; start anew"
                )
            mismatches = differences(content["begun with"], begun_with)
            if mismatches:
                raise ModelError(
                    f"{path}: this checkpoint belongs to another identification:\n  "
                    + "\n  ".join(mismatches)
                    + "\n  Continue it with what it was begun with, or start anew."
                )
            state: State = _unpacked(content["state"], archive)
            return state
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no checkpoint to continue from") from None
    except ModelError:
        raise
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ModelError(f"{path}: not a checkpoint of a search: {error}") from None


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """Differences of two origins, in words."""
    model, name = there["model"], here["model"]["name"]
    if model["name"] != name:
        return [f"it searches model {model['name']}, this is {name}"]
    parts = ("equations", "signals and parameters")
    changed = [part for part in parts if model.get(part) != here["model"].get(part)]
    lines = [f"the {part} of model {name} have changed" for part in changed]
    if len(there["records"]) != len(here["records"]):
        lines.append(f"it has {len(there['records'])} record(s), here are {len(here['records'])}")
    for k, (old, new) in enumerate(zip(there["records"], here["records"], strict=False), 1):
        names = old["name"] if old["name"] == new["name"] else f"{old['name']}, {new['name']} here"
        sizes = [key for key in ("samples", "sample time") if old[key] != new[key]]
        if sizes:
            key = sizes[0]
            lines.append(f"record {k} ({names}): {key} {old[key]:g}, here {new[key]:g}")
        elif old["values"] != new["values"]:
            lines.append(f"record {k} ({names}) has other values")
    for key in sorted({*there["settings"], *here["settings"]}):
        was, now = there["settings"].get(key), here["settings"].get(key)
        if was != now:
            lines.append(f"{key} is {was}, here {now}")
    return lines


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _packed(value: Any, arrays: dict[str, Any]) -> Any:
    """A value in JSON's types, its arrays put aside."""
    if isinstance(value, np.ndarray):
        name = f"array{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, dict):
        return {"dict": {key: _packed(item, arrays) for key, item in value.items()}}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_packed(item, arrays) for item in value]}
    return value.item() if isinstance(value, np.generic) else value


def _unpacked(value: Any, archive: Mapping[str, Any]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return np.array(archive[content])
    if kind == "dict":
        return {key: _unpacked(item, archive) for key, item in content.items()}
    return {"list": list, "tuple": tuple}[kind](_unpacked(item, archive) for item in content)
