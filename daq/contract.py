"""The contract with a backend, checked at every call: a breach is a DeviceError in words."""

import functools
import json
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from typing import Any, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from daq.errors import (
    ConfigError,
    DeviceError,
    RigError,
    RunError,
    Terminated,
    UnreachedError,
    raised_in,
)
from daq.hal import ANALOG_INPUTS, CHANNELS, Device, DeviceInfo, IntArray, RawSamples

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_CURE = "mend the backend, or report this to who maintains it"
_INFO = TypeAdapter(DeviceInfo)
_WHOLE, _REAL = np.dtype(np.int64), np.dtype(np.float64)
# Of each field of RawSamples: what is handed on, kinds of numpy that are taken for it, and the
# dimensions behind the first.
_COLUMNS = {
    "tick": (_WHOLE, "iu", ()),
    "analog": (_REAL, "fiu", (len(ANALOG_INPUTS),)),
    "counts": (_REAL, "fiu", ()),
    "count_rate": (_REAL, "fiu", ()),
    "applied": (_REAL, "fiu", (len(CHANNELS),)),
    "flags": (_WHOLE, "iub", ()),
}
_FORM = ("__class__", "dtype", "shape")
_form_of = attrgetter(*(f"{name}.{part}" for name in _COLUMNS for part in _FORM))


def printable(text: str) -> str:
    r"""Text with its control characters as escapes: none moves the cursor or begins a line.

    >>> print(printable("volts \x1b[2J\n"))
    volts \x1b[2J\n
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def call(
    method: Callable[_Arguments, _Result], *args: _Arguments.args, **kwargs: _Arguments.kwargs
) -> _Result:
    """What a method of a backend returns.

    Raises DeviceError, ConfigError and RunError as the method does, and DeviceError for whatever
    else it raises but signals; control characters are escaped.
    """
    try:
        return method(*args, **kwargs)
    except (KeyboardInterrupt, Terminated):
        raise
    except BaseException as error:
        cause = error
    # Outside of the clause, so that notes of a backend's error are not shown as the program's.
    raise _in_words(method, cause) from cause


def _in_words(method: Callable[..., Any], error: BaseException) -> RigError:
    if isinstance(error, RigError) and str(error).strip():
        kinds = ConfigError, RunError, UnreachedError
        kind = next((kind for kind in kinds if type(error) is kind), DeviceError)
        return kind.of(
            replace(mistake, problem=printable(mistake.problem), cure=printable(mistake.cure))
            for mistake in error.mistakes
        )
    text = printable("".join(traceback.format_exception_only(error)).strip())
    place = raised_in(type(getattr(method, "__self__", None)), error)
    return _breach(f"failed in {getattr(method, '__name__', method)}(): {text}{place}")


def _breach(problem: str) -> DeviceError:
    return DeviceError(f"the backend {problem}", cure=_CURE)


def checked_info(info: object) -> DeviceInfo:
    """What ``open`` returned. Raises DeviceError for a field of another type or range."""
    if not isinstance(info, DeviceInfo):
        raise _breach(f"returned {type(info).__name__} from open(); DeviceInfo is expected")
    try:
        checked = _INFO.validate_python(vars(info))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(("DeviceInfo", *map(str, first["loc"])))
        value = printable(f"{first['input']!r:.60}")
        problem = f"returned {value} for {name} from open(): {first['msg']}"
        raise _breach(problem) from None
    return replace(checked, name=printable(checked.name))


@contextmanager
def opened(device: Device) -> Iterator[DeviceInfo]:
    """What a device says of itself, open meanwhile."""
    try:
        yield checked_info(call(device.open))
    finally:
        call(device.close)


def checked_room(room: object) -> int:
    """What ``room`` returned. Raises DeviceError for what is no whole number."""
    if not isinstance(room, int | np.integer):
        raise _breach(f"returned {type(room).__name__} from room(); a whole number is expected")
    return int(room)


def checked_samples(raw: object, last_tick: int) -> RawSamples:
    """What ``receive`` returned behind the sample ``last_tick``, as arrays of the types it has.

    Raises DeviceError for a block without rows, fields of other shapes or types, and ticks that do
    not rise.
    """
    if not isinstance(raw, RawSamples):
        raise _breach(f"returned {type(raw).__name__} from receive(); RawSamples are expected")
    if not _fits(raw):
        n = _array(raw.tick).size
        raw = RawSamples(**{name: _column(raw, name, n) for name in _COLUMNS})
    ticks = raw.tick
    if not ticks.size:
        raise _breach("returned a block without samples; receive() waits until there is one")
    if ticks.item(0) <= last_tick or (ticks.size > 1 and not (ticks[1:] > ticks[:-1]).all()):
        raise _breach(_not_rising(ticks, last_tick))
    return raw


def _fits(raw: RawSamples) -> bool:
    """Whether all is as most backends have it; asked of every sample in closed loop."""
    try:
        return bool(_form_of(raw) == _form(raw.tick.size))
    except AttributeError:  # something is no array
        return False


@functools.lru_cache
def _form(n: int) -> tuple[Any, ...]:
    """Class, type and shape of the fields of n rows, one behind the other."""
    columns = [(np.ndarray, dtype, (n, *width)) for dtype, _, width in _COLUMNS.values()]
    return tuple(chain.from_iterable(columns))


def _column(raw: RawSamples, name: str, n: int) -> Any:
    dtype, kinds, width = _COLUMNS[name]
    column = _array(getattr(raw, name))
    if column.dtype.kind not in kinds or column.shape != (n, *width):
        kind = "whole" if dtype == _WHOLE else "real"
        raise _breach(
            f"returned RawSamples.{name} of shape {column.shape} and type {column.dtype}; "
            f"{kind} numbers of shape {(n, *width)} are expected"
        )
    return column.astype(dtype)


def _array(values: object) -> npt.NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError:  # rows of several lengths
        return np.asarray(None)


def _not_rising(ticks: IntArray, last_tick: int) -> str:
    before = np.concatenate([[last_tick], ticks[:-1]])
    row = int(np.argmax(ticks <= before))
    return (
        f"returned tick {ticks[row]} behind tick {before[row]}; RawSamples.tick counts the samples "
        "since start(), and must rise"
    )


def checked_report(report: object) -> dict[str, Any]:
    """What ``report`` returned. Raises DeviceError for what a record cannot hold."""
    try:
        document = json.loads(json.dumps(report, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise _breach(f"returned from report() what JSON cannot hold: {error}") from None
    if not isinstance(document, dict):
        raise _breach(f"returned {type(report).__name__} from report(); a dictionary is expected")
    warnings = document.get("warnings", [])
    if not isinstance(warnings, list) or not all(isinstance(text, str) for text in warnings):
        raise _breach("returned from report() 'warnings' that are not a list of texts")
    return document | {"warnings": list(map(printable, warnings))} if warnings else document
