"""Logs in MATLAB's binary files, as tables of named columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from daq.errors import ConfigError
from daq.hal import FloatArray

SUFFIX = ".mat"
_CONVERT = (
    "in MATLAB: writematrix or writetable(T, 'log.csv'), or save('log.mat', 't', 'u', 'y', '-v7') "
    "with plain arrays"
)


def columns_of(path: Path) -> dict[str, FloatArray]:
    """The arrays of a MAT file (level 5, ``save -v7`` and before) as columns by name.

    A vector is a column under its variable's name, fields of structures as ``data.u``, columns of
    a matrix as ``y(:,2)``. Raises ConfigError with the way to convert a file that does not read,
    among them those of version 7.3.
    """
    from scipy.io import loadmat

    try:
        variables = loadmat(path, squeeze_me=False, struct_as_record=True, appendmat=False)
    except FileNotFoundError:
        cure = "name a capture folder, a CSV or a MAT file"
        raise ConfigError("there is no such log", cure=cure, file=path) from None
    except NotImplementedError:
        problem = "a MAT file of version 7.3, which only HDF5 programs read"
        raise ConfigError(problem, cure=_CONVERT, file=path) from None
    except Exception as error:  # of damaged files SciPy raises anything, zlib's errors as well
        if isinstance(error, OSError) and error.strerror:
            raise ConfigError(f"cannot be read: {error.strerror}", file=path) from None
        problem = f"no MAT file, or a damaged one ({error})"
        raise ConfigError(problem, cure=_CONVERT, file=path) from None
    columns = dict(_columns(variables))
    if not columns:
        problem = "this MAT file holds no arrays of numbers (tables and timeseries do not read)"
        raise ConfigError(problem, cure=_CONVERT, file=path)
    return columns


def _columns(variables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, FloatArray]]:
    for name, value in variables.items():
        if name.startswith("__") or not isinstance(value, np.ndarray):
            continue
        if value.dtype.names is not None and value.size == 1:
            fields = {field: value[field].flat[0] for field in value.dtype.names}
            yield from _columns(fields, f"{prefix}{name}.")
        elif value.dtype.kind in "fiub" and value.ndim == 2 and value.size > 1:
            yield from _vectors(f"{prefix}{name}", value.astype(np.float64))


def _vectors(name: str, array: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    if 1 in array.shape:
        yield name, array.ravel()
        return
    for j, column in enumerate(array.T, 1):
        yield f"{name}(:,{j})", column
