"""Logs: exact to the bit, readable however they were cut, and never a wrong number."""

import math
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daq.errors import ConfigError, RunError
from daq.hal import Flag, Samples
from daq.identification import records as datasets
from daq.logs.columns import COLUMNS, ORIGINAL_COLUMNS
from daq.logs.recording import load
from daq.logs.table import read_table
from daq.logs.time_base import time_base
from daq.logs.writer import LogWriter
from sim_rig.actuator import actuator
from tests.daq.support import (
    file_limit,
    install_faulty,
    journal_of,
    only_capture,
    record_of,
    rig,
    write_experiment,
    write_rig,
)

VALUES = [name for name in COLUMNS if name not in ("t", "tick", "flags")]


def samples(n, rate=800.0, first=0, **columns):
    tick = np.arange(first, first + n)
    base = {name: np.zeros(n) for name in VALUES}
    base |= {"tick": tick, "time": tick / rate, "flags": np.zeros(n, dtype=np.int64)}
    return Samples(**{**base, **columns})


def original_text(n=10, dt=0.001):
    """A log as the original program wrote it."""
    rows = [
        ", ".join(repr(v) for v in (k * dt, 0.5, 0.1, 0.25 * k, 0.05, -0.01, 0.001 * k, 1.0))
        for k in range(n)
    ]
    return ", ".join(ORIGINAL_COLUMNS) + "\n" + "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def real_log(tmp_path_factory):
    """The log of a real run."""
    root = tmp_path_factory.mktemp("real")
    write_experiment(root / "e.yaml", duration=0.1)
    result = rig("run", "e.yaml", cwd=root)
    assert result.returncode == 0, result.stderr
    return only_capture(root) / "log.csv"


# --- round trip ---------------------------------------------------------------------------

finite = st.floats(allow_nan=False, allow_infinity=False)


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    cells=st.lists(
        st.lists(finite, min_size=len(VALUES), max_size=len(VALUES)), min_size=2, max_size=30
    ),
    rate=st.sampled_from([10.0, 333.3, 800.0, 1000.0, 20_000.0]),
    first=st.integers(0, 10**9),
    cut=st.integers(1, 29),
    flags=st.integers(0, 63),
)
def test_what_is_written_is_read_back_to_the_bit(tmp_path, cells, rate, first, cut, flags):
    table = np.array(cells)
    block = samples(
        len(table),
        rate,
        first,
        flags=np.full(len(table), flags),
        **{name: table[:, j] for j, name in enumerate(VALUES)},
    )
    path = tmp_path / "log.csv"
    path.unlink(missing_ok=True)
    with LogWriter(path) as log:
        for rows in (slice(0, cut), slice(cut, None)):
            part = Samples(**{k: v[rows] for k, v in vars(block).items()})
            if len(part):
                log.append(part)
        assert log.n_samples == len(block)
    loaded = load(path)
    assert not loaded.torn
    for column in COLUMNS:
        written = getattr(block, "time" if column == "t" else column)
        read = loaded.frame[column].to_numpy()
        assert written.astype(read.dtype).tobytes() == read.tobytes(), column
    assert loaded.dt == pytest.approx(1.0 / rate, rel=1e-6)


decimals = st.from_regex(
    r"[+-]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][+-]?[0-9]{1,3})?", fullmatch=True
)


@settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(cells=st.lists(decimals.filter(lambda cell: math.isfinite(float(cell))), min_size=1))
def test_any_decimal_is_read_as_python_reads_it(tmp_path, cells):
    path = tmp_path / "table.csv"
    path.write_text("x,y\n" + "".join(f"{cell},1\n" for cell in cells))
    read = read_table(path)[0]["x"]
    assert read.tobytes() == np.array([float(cell) for cell in cells]).tobytes()


@pytest.mark.soak
def test_a_long_log_is_read_whole_and_its_mistakes_found(tmp_path):
    path = tmp_path / "long.csv"
    rng, n = np.random.default_rng(5), 75_000
    written = samples(n, torque=rng.normal(size=n), omega=rng.normal(size=n))
    with LogWriter(path) as log:
        log.append(written)
    data = path.read_bytes()
    assert len(data) > 4_500_000  # which is more than is read at a time
    for text, torn in ((data, False), (data + b"\n\n", False), (data + b"93.75,0.0,0.", True)):
        path.write_bytes(text)
        loaded = load(path)
        assert loaded.torn == torn and len(loaded.frame) == n
        for column in ("tick", "torque", "omega"):
            assert loaded.frame[column].to_numpy().tobytes() == getattr(written, column).tobytes()
    lines = data.decode().splitlines()
    for wrong, said in (("", "t: ''"), ("1.0,oops", "cmd_voltage_motor: 'oops'")):
        path.write_text("\n".join([*lines[:70_000], wrong, *lines[70_001:]]) + "\n")
        with pytest.raises(ConfigError, match=f"long.csv:70001: {said} is not a finite number"):
            load(path)


def test_a_log_is_never_overwritten(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("precious")
    with pytest.raises(RunError, match="exists"):
        LogWriter(path)
    assert path.read_text("utf-8") == "precious"


def test_the_original_programs_format_loads(tmp_path):
    path = tmp_path / "old.csv"
    path.write_text(original_text())
    log = load(path)
    assert list(log.frame["current_motor"]) == [0.25 * k for k in range(10)]
    assert log.frame["tick"].tolist() == list(range(10)) and log.dt == pytest.approx(0.001)
    # It applied what it asked for, as far as its log knows.
    assert (log.frame["applied_voltage_motor"] == 0.5).all()
    assert (log.frame["flags"] == 0).all()
    assert load(path).warning is None


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: text.replace("\n", "\r\n"), id="Windows line ends"),
        pytest.param(lambda text: "\ufeff" + text, id="byte order mark"),
        pytest.param(lambda text: text.replace(", ", ",  "), id="blanks"),
        pytest.param(lambda text: text + "\n\n", id="blank lines at the end"),
        pytest.param(
            lambda text: ",".join(f'"{n}"' for n in ORIGINAL_COLUMNS) + text[text.index("\n") :],
            id="quoted header",
        ),
        pytest.param(lambda text: text.replace("\n", ", \n"), id="a separator at each line's end"),
        pytest.param(lambda text: text.replace("\n", ",,\n"), id="two of them"),
        pytest.param(lambda text: text.replace(", ", "\t"), id="tabs"),
        pytest.param(
            lambda text: text.replace(", ", ";").replace(".", ","), id="semicolons, decimal commas"
        ),
        pytest.param(lambda text: "# Bench 3\n\n% 1 kHz, held\n" + text, id="comments before"),
        pytest.param(lambda text: "# Bench 3, held\n# " + text, id="a header as NumPy writes it"),
    ],
)
def test_harmless_variants_of_a_table_load_alike(tmp_path, change):
    path = tmp_path / "log.csv"
    path.write_text(original_text())
    plain = load(path).frame
    path.write_bytes(change(original_text()).encode())
    assert load(path).frame.equals(plain)


# --- truncation ---------------------------------------------------------------------------


@pytest.mark.soak
def test_a_log_cut_anywhere_loads_without_a_wrong_number_or_says_why(real_log, tmp_path):
    data = real_log.read_bytes()
    whole = load(real_log).frame
    path = tmp_path / "log.csv"
    body = data.index(b"\n") + 1
    third = body + len(b"".join(data[body:].splitlines(keepends=True)[:3]))
    rng = np.random.default_rng(20)
    # Every byte of the header and the first rows and the last row, and a sample of the others.
    cuts = [*range(third), *rng.integers(third, len(data), 150), *range(len(data) - 120, len(data))]
    for cut in map(int, cuts):
        path.write_bytes(data[:cut])
        rows = data[:cut].count(b"\n") - 1
        if rows < 2:
            with pytest.raises(ConfigError) as refused:
                load(path)
            assert str(refused.value).startswith(str(path)), cut
            continue
        log = load(path)
        assert len(log.frame) == rows, cut
        assert log.frame.equals(whole.iloc[:rows]), cut
        assert log.torn == (data[:cut][-1:] != b"\n"), cut


def test_a_cut_log_is_named_interrupted(real_log, tmp_path):
    path = tmp_path / "lone.csv"
    path.write_bytes(real_log.read_bytes()[:-5])
    assert "interrupted; its last line is incomplete and is left out" in load(path).warning


def test_blocks_of_zero_bytes_after_a_power_failure_are_left_out(real_log, tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(real_log.read_bytes() + b"\0" * 4096)
    log = load(path)
    assert log.torn and log.frame.equals(load(real_log).frame)


# --- lost samples -------------------------------------------------------------------------


def _log_with_gap(tmp_path, original=False):
    n, lost = 60, slice(20, 27)
    motor = 0.01 * np.arange(n)
    block = samples(n, current_motor=motor, applied_voltage_motor=motor, cmd_voltage_motor=motor)
    kept = np.delete(np.arange(n), lost)
    path = tmp_path / "log.csv"
    with LogWriter(path) as log:
        log.append(Samples(**{k: v[kept] for k, v in vars(block).items()}))
    if original:
        import pandas as pd

        frame = pd.read_csv(path)[list(ORIGINAL_COLUMNS)]
        path.unlink()
        path = tmp_path / "old.csv"
        frame.to_csv(path, index=False)
    return path, kept


@pytest.mark.parametrize("original", [False, True])
def test_lost_samples_keep_their_place_in_time(tmp_path, original):
    path, kept = _log_with_gap(tmp_path, original)
    assert load(path).frame["tick"].tolist() == kept.tolist()
    data = datasets.load(path, actuator(), None).dataset
    assert data.n_samples == 60 and data.dt == pytest.approx(1 / 800)
    assert np.isnan(data.outputs[20:27]).all()
    assert np.isfinite(np.delete(data.outputs, slice(20, 27), axis=0)).all()
    np.testing.assert_allclose(data.outputs[kept, 0], 0.01 * kept)
    # The input of the last row before the gap is held over it.
    np.testing.assert_allclose(data.inputs[20:27, 0], 0.19)
    np.testing.assert_allclose(data.inputs[27, 0], 0.27)


def test_a_log_that_begins_late_begins_with_its_first_row(tmp_path):
    path = tmp_path / "log.csv"
    with LogWriter(path) as log:
        log.append(samples(10, first=500))
    assert load(path).frame["tick"].tolist() == list(range(500, 510))
    assert datasets.load(path, actuator(), None).dataset.n_samples == 10


def test_times_printed_with_few_digits_give_the_true_sample_time(tmp_path):
    path = tmp_path / "old.csv"
    lines = original_text(801, 1 / 800).splitlines()
    rounded = [lines[0]]
    for k, line in enumerate(lines[1:]):
        rounded.append(f"{k / 800:.4f}" + line[line.index(",") :])
    path.write_text("\n".join(rounded) + "\n")
    log = load(path)
    assert log.dt == pytest.approx(1 / 800, rel=1e-4)
    assert log.frame["tick"].tolist() == list(range(801))


# --- what is no log -----------------------------------------------------------------------


def _lines(*changes, n=10):
    lines = original_text(n).splitlines()
    for line, column, cell in changes:
        cells = lines[line - 1].split(", ")
        cells[column] = cell
        lines[line - 1] = ", ".join(cells)
    return "\n".join(lines) + "\n"


def _own(changes):
    """A log of this program with cells changed: {(line, column): text}."""
    rows = [list(COLUMNS)]
    for k in range(10):
        rows.append([repr(k / 800), *["0.0"] * 7, str(k), "0.0", "0.0", "0"])
    for (line, column), cell in changes.items():
        rows[line - 1][COLUMNS.index(column)] = cell
    return "\n".join(map(",".join, rows)) + "\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        pytest.param("", "empty", id="empty file"),
        pytest.param("\n\n", "empty", id="blank file"),
        pytest.param(original_text(0), "holds 0 samples", id="only the header"),
        pytest.param(original_text(1), "holds 1 sample;", id="one row"),
        pytest.param(_lines((5, 3, "nan")), ":5: current_motor: 'nan' is not a finite", id="NaN"),
        pytest.param(_lines((5, 3, "inf")), ":5: current_motor: 'inf' is not a finite", id="inf"),
        pytest.param(_lines((6, 5, "n/a")), ":6: torque: 'n/a' is not a finite number", id="text"),
        pytest.param(_lines((6, 5, "")), ":6: torque: '' is not a finite number", id="empty cell"),
        pytest.param(_lines((6, 5, "1_0")), ":6: torque: '1_0' is not a finite", id="underscore"),
        pytest.param(_lines((6, 5, "0x1F")), ":6: torque: '0x1F' is not a finite", id="hex"),
        pytest.param(_lines((6, 5, "True")), ":6: torque: 'True' is not a finite", id="truth"),
        pytest.param(_lines((4, 0, "0.001")), ":4: t: time does not advance", id="time stands"),
        pytest.param(_lines((4, 0, "-1")), ":4: t: time does not advance", id="time goes back"),
        pytest.param(
            _lines((8, 0, "0.0065")), ":8: t: samples are 0.001 s apart elsewhere but 0.0015 s",
            id="uneven time",
        ),
        pytest.param(
            original_text().replace("torque", "torq"),
            ":1: column 'torque' is missing; did you mean 'torq'?",
            id="missing column",
        ),
        pytest.param(
            original_text().replace("cmd_voltage_brake", "theta", 1),
            ":1: column 'theta' stands twice",
            id="column twice",
        ),
        pytest.param(
            original_text().split("\n", 1)[1], ":1: the first line holds numbers", id="no header"
        ),
        pytest.param(
            original_text().replace("0.5, 0.1", "0,5, 0,1"), ":2: ", id="decimal commas"
        ),
        pytest.param(
            "\n".join(s[: s.rindex(",")] if k == 4 else s
                      for k, s in enumerate(original_text().splitlines())) + "\n",
            ":5: omega: '' is not a finite number",
            id="a cell too few",
        ),
        pytest.param(_own({(5, "tick"): "2"}), ":5: tick: it does not advance", id="tick stands"),
        pytest.param(_own({(5, "tick"): "3.5"}), ":5: tick: it must be a whole", id="half a tick"),
        pytest.param(_own({(5, "flags"): "0.5"}), ":5: flags: it must be a whole", id="flag"),
        pytest.param(
            _own({(6, "tick"): "4", (6, "t"): "0.0057"}), ":6: t: samples are", id="no time"
        ),
    ],
)  # fmt: skip
def test_a_file_that_is_no_log_is_refused_by_file_line_and_column(tmp_path, text, said):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ConfigError) as refused:
            load(path)
    assert str(refused.value).startswith(str(path)) and said in str(refused.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", "not a text file"),
        (original_text().encode("utf-16"), "it is UTF-16; export the table as CSV in UTF-8"),
        (b"PK\x03\x04" + bytes(range(256)), "not a text file"),
        (bytes(4096), "not a text file: .*; export the table as CSV"),
    ],
    ids=["picture", "UTF-16", "spreadsheet", "zeros"],
)
def test_a_binary_file_is_refused_as_such(tmp_path, data, said):
    path = tmp_path / "bad.csv"
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=said):
        load(path)


def test_a_table_keeps_only_the_columns_asked_for(tmp_path):
    path = tmp_path / "foreign.csv"
    path.write_text("time;x\n".replace(";", ",") + "0,1\n1,2\n2,3\n")
    table, _, _ = read_table(path, ["x"])
    assert list(table) == ["x"] and table["x"].tolist() == [1.0, 2.0, 3.0]


def test_a_table_in_a_german_programs_character_set(tmp_path):
    path = tmp_path / "messung.csv"
    path.write_bytes(
        "Zeit [s];Drehzahl [1/min];Übertemperatur [°C]\n0;1,5;2\n1;-3e2;4\n".encode("cp1252")
    )
    table, _, _ = read_table(path, ["Drehzahl [1/min]", "Übertemperatur [°C]"])
    assert np.array([*table.values()]).T.tolist() == [[1.5, 2.0], [-300.0, 4.0]]


def test_lines_are_counted_from_the_files_start(tmp_path):
    path = tmp_path / "noted.csv"
    path.write_text("# a\n# b\nt,x\n0,1\n1,oops\n")
    with pytest.raises(ConfigError, match=r"noted.csv:5: x: 'oops' is not a finite number"):
        read_table(path, ["x"])
    path.write_text("# a\n# b\n" + original_text().replace("0.004,", "0.0001,"))
    with pytest.raises(ConfigError, match=r"noted.csv:8: t: time does not advance"):
        load(path)


def test_columns_that_are_not_asked_for_may_hold_anything(tmp_path):
    path = tmp_path / "noted.csv"
    lines = original_text().splitlines()
    notes = ["remark", *["see notebook, p. 4" if k == 3 else "" for k in range(10)]]
    path.write_text("\n".join(f'{a}, "{b}"' for a, b in zip(lines, notes, strict=True)) + "\n")
    assert len(load(path).frame) == 10


# --- the disk is full ---------------------------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit")
def test_a_full_disk_ends_the_run_safely_with_a_log_that_loads(tmp_path):
    env = install_faulty(tmp_path / "plugin")
    write_experiment(tmp_path / "e.yaml", duration=5)
    write_rig(tmp_path / "rig.yaml", backend="faulty", options={"journal": "/dev/shm/" + str(
        abs(hash(tmp_path)))})  # fmt: skip
    journal = Path(f"/dev/shm/{abs(hash(tmp_path))}")
    # Bytes a file may grow to; Python ignores the signal that comes with it. Room for what a
    # capture keeps for its last words, and for a part of the log.
    limit = 100_000

    small_disk = file_limit(limit)
    try:
        result = rig(
            "run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path, env=env, preexec_fn=small_disk
        )
        entries = journal_of(journal)
    finally:
        journal.unlink(missing_ok=True)
    assert result.returncode == 1 and "Traceback" not in result.stderr
    folder = only_capture(tmp_path)
    relative = folder.relative_to(tmp_path) / "log.csv"
    last = result.stderr.splitlines()[-1]
    assert last.startswith(f"rig: {relative}: cannot be written: File too large;")
    assert "Free space on the disk, or choose another with --out" in last
    log = load(folder)
    n = len(log.frame)
    assert f"the first {n} samples are in it" in last
    assert (folder / "log.csv").stat().st_size == limit and log.torn and n > 100
    assert np.array_equal(log.frame["tick"], np.arange(n))
    record = record_of(folder)
    assert record["status"] == "failed" and "cannot be written" in record["reason"]
    outputs = [entry for entry in entries if entry["what"] == "outputs"]
    assert outputs and not np.any(outputs[-1]["applied"]) and entries[-1]["what"] == "close"


@pytest.mark.soak
@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit")
def test_a_disk_full_from_the_start_is_no_traceback(tmp_path):
    write_experiment(tmp_path / "e.yaml")
    result = rig("run", "e.yaml", cwd=tmp_path, preexec_fn=file_limit(100))
    assert result.returncode == 1
    assert "cannot be written: File too large" in result.stderr
    assert "Traceback" not in result.stderr


def test_flags_are_the_documented_bits():
    assert [flag.value for flag in Flag] == [1, 2, 4, 8, 16, 32, 64, 128]
    assert math.log2(max(Flag)) < 63 and sys.maxsize > max(Flag)


def test_a_last_cell_without_a_number_costs_no_row_in_a_column_that_is_not_read(tmp_path):
    path = tmp_path / "other.csv"
    path.write_text("t,y,remark\n0,1.5,ok\n1,2.5,nan\n")
    table, _, torn = read_table(path, ["t", "y"])
    assert table["y"].tolist() == [1.5, 2.5] and not torn


def test_a_row_between_two_samples_is_refused_with_its_line():
    time = np.array([0.0, 0.1, 0.2, 0.21, 0.3, 0.4])
    with pytest.raises(
        ConfigError, match=r"log\.csv:5: t: samples are 0\.1 s apart elsewhere but "
    ):
        time_base(Path("log.csv"), time)
