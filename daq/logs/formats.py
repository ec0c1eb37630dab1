"""Logs in the files that other programs read, with units and the record of the run inside."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from datetime import datetime, timedelta
from io import BytesIO
from pathlib import Path
from typing import Any

from daq.errors import ConfigError
from daq.files import write_whole
from daq.logs.columns import UNITS
from daq.logs.recording import Recording

_TOPIC = "/samples"
_NANOSECONDS = 1_000_000_000


def write_mat(recording: Recording, path: Path) -> None:
    """A MAT file of level 5: a vector for each column, ``units`` and ``dt`` [s], ``record``.

    ``units`` is a structure of texts by column, ``record`` what run.json holds, as its text
    (``jsondecode(record)``); time is in seconds from the run's start, as in the log. Raises
    RunError where the file cannot be written.
    """
    from scipy.io import savemat

    columns = {_matlab_name(name): values for name, values in recording.columns.items()}
    units = {_matlab_name(name): UNITS[name] for name in recording.columns if name in UNITS}
    content = columns | {"units": units, "dt": recording.dt, "record": _record(recording)}
    file: Any = BytesIO()  # its stubs know no files but by their paths
    savemat(file, content, oned_as="column", long_field_names=True, do_compression=True)
    write_whole(path, file.getvalue())


def write_parquet(recording: Recording, path: Path) -> None:
    """A Parquet table: ``unit`` in each column's metadata, ``dt`` and ``record`` in the table's.

    Raises RunError where the file cannot be written, ConfigError where pyarrow is missing.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise _missing("pyarrow") from None
    table = pa.Table.from_pandas(recording.frame, preserve_index=False)
    fields = [field.with_metadata({"unit": UNITS.get(field.name, "")}) for field in table.schema]
    facts = {"dt": repr(recording.dt), "record": _record(recording)}
    table = table.cast(pa.schema(fields, metadata=table.schema.metadata))
    file = BytesIO()
    parquet.write_table(table.replace_schema_metadata(table.schema.metadata | facts), file)
    write_whole(path, file.getvalue())


def write_mcap(recording: Recording, path: Path) -> None:
    """An MCAP file, for Foxglove and PlotJuggler: a JSON message a sample on ``/samples``.

    Times are those of the run, from run.json's ``started`` on; units stand in the schema, run.json
    is attached. What was not measured is ``null``. Raises ConfigError where the file cannot be
    written, or mcap is missing.
    """
    try:
        from mcap.writer import Writer
    except ImportError:
        raise _missing("mcap") from None
    file = BytesIO()
    writer = Writer(file)
    writer.start(profile="", library="hybrid-rig")
    schema = writer.register_schema(
        name="samples", encoding="jsonschema", data=json.dumps(_schema(recording)).encode()
    )
    units = {name: UNITS.get(name, "") for name in recording.columns}
    channel = writer.register_channel(
        topic=_TOPIC, message_encoding="json", schema_id=schema, metadata=units
    )
    began = _began(recording)
    rows = recording.frame.to_json(orient="records", lines=True, double_precision=15).splitlines()
    times = recording.columns["t"]
    for sequence, (time, row) in enumerate(zip(times, rows, strict=True)):
        stamp = began + round(float(time) * _NANOSECONDS)
        writer.add_message(channel, stamp, row.encode(), stamp, sequence)
    writer.add_metadata("hybrid-rig", {"log": recording.name, "dt": repr(recording.dt)})
    writer.add_attachment(began, began, "run.json", "application/json", _record(recording).encode())
    writer.finish()  # type: ignore[no-untyped-call]
    write_whole(path, file.getvalue())


WRITERS: dict[str, Callable[[Recording, Path], None]] = {
    "mat": write_mat,
    "mcap": write_mcap,
    "parquet": write_parquet,
}


def _record(recording: Recording) -> str:
    return json.dumps(recording.record or {})


def _schema(recording: Recording) -> dict[str, object]:
    properties = {
        name: {"type": ["number", "null"], "description": f"[{UNITS[name]}]"}
        if name in UNITS
        else {"type": ["number", "null"]}
        for name in recording.columns
    }
    return {"type": "object", "properties": properties}


def _began(recording: Recording) -> int:
    """When t was zero, in nanoseconds since 1970; 0 of a log that no record belongs to."""
    try:
        started = datetime.fromisoformat(str((recording.record or {})["started"]))
    except (KeyError, ValueError):
        return 0
    epoch = datetime.fromtimestamp(0, started.tzinfo)
    return (started - epoch) // timedelta(microseconds=1) * 1000


def _matlab_name(name: str) -> str:
    """A name that MATLAB takes for a variable."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return plain if plain[:1].isalpha() else f"x{plain}"


def _missing(package: str) -> ConfigError:
    cure = "install it with pip install 'hybrid-rig[formats]', or write mat"
    return ConfigError(f"that needs the package {package}, which is not installed", cure=cure)
