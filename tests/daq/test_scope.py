"""What the scope reads and keeps of a log, and its command; the page itself needs a browser."""

import contextlib
import http.client
import json
import signal
import socket
import subprocess
import sys
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from bokeh.util.token import generate_jwt_token
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.hal import Samples
from daq.logs.columns import COLUMNS
from daq.logs.recording import load
from daq.logs.writer import LogWriter
from daq.process import RunProcess
from daq.scope.history import History
from daq.scope.planes import spectra
from daq.scope.tail import LogTail
from daq.scope.texts import heading
from daq.scope.trigger import Trigger
from daq.scope.watch import FollowedLog, RunState, Watch
from tests.daq.support import (
    environment,
    record_of,
    rig,
    rows_in,
    start_rig,
    until,
    write_experiment,
    write_rig,
)

RATE = 800.0


def samples(n, first=0, **columns):
    """n samples of something like noise, with what ``columns`` say instead."""
    rng = np.random.default_rng(first)
    tick = np.arange(first, first + n)
    fields = {name: rng.normal(size=n) for name in Samples.__dataclass_fields__}
    fields |= {"tick": tick, "time": tick / RATE, "flags": np.zeros(n, dtype=int), **columns}
    return Samples(**fields)


def write_log(folder, n, **columns):
    folder.mkdir(parents=True, exist_ok=True)
    with LogWriter(folder / "log.csv") as log:
        log.append(samples(n, **columns))
    return folder / "log.csv"


def all_rows(tail):
    """Everything that can be read now."""
    blocks, before = [tail.poll()[0]], 0
    while tail.offset > before:
        before = tail.offset
        blocks.append(tail.poll()[0])
    return np.concatenate(blocks)


# --- reading ------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(cuts=st.lists(st.integers(0, 20_000), max_size=12), n=st.integers(2, 120))
def test_a_log_read_as_it_grows_is_the_log_read_at_its_end(tmp_path_factory, cuts, n):
    folder = tmp_path_factory.mktemp("log")
    data = write_log(folder / "whole", n).read_bytes()
    growing = folder / "log.csv"
    tail = LogTail(growing)
    assert len(tail.poll()[0]) == 0  # before there is a file
    rows = []
    for cut in [*sorted(cut % len(data) for cut in cuts), len(data)]:
        growing.write_bytes(data[:cut])
        rows += tail.poll()[0].tolist()
        assert not tail.problems.count and tail.fault is None
    expected = load(folder / "whole" / "log.csv").frame[list(COLUMNS)].to_numpy()
    assert tail.columns == COLUMNS
    np.testing.assert_array_equal(rows, expected)
    assert not tail.torn()


def test_large_and_small_reads_give_the_same_numbers(tmp_path):
    path = write_log(tmp_path, 3000)
    expected = load(path).frame[list(COLUMNS)].to_numpy()
    np.testing.assert_allclose(all_rows(LogTail(path)), expected, rtol=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "t, cmd_voltage_motor, torque\n0.0, 1.0, 0.5\n0.1, 2.0, 0.25\n",
        "t;cmd_voltage_motor;torque\r\n0,0;1,0;0,5\r\n0,1;2,0;0,25\r\n",
        "\ufeff# made elsewhere\n\nt\tcmd_voltage_motor\ttorque\n0.0\t1.0\t0.5\n0.1\t2.0\t0.25\n",
        "# t,cmd_voltage_motor,torque\n0.0,1.0,0.5\n0.1,2.0,0.25\n",
    ],
    ids=["original program", "semicolons", "comments and tabs", "numpy"],
)
def test_other_programs_logs_are_read(tmp_path, text):
    path = tmp_path / "other.csv"
    path.write_bytes(text.encode())
    tail = LogTail(path)
    assert all_rows(tail).tolist() == [[0.0, 1.0, 0.5], [0.1, 2.0, 0.25]]
    assert tail.columns == ("t", "cmd_voltage_motor", "torque")
    assert "without column cmd_voltage_brake, current_motor" in tail.problems.first[0]


@pytest.mark.parametrize("bulk", [False, True], ids=["few rows", "many rows"])
def test_what_is_broken_is_left_out_and_told(tmp_path, bulk):
    path = write_log(tmp_path, 2000 if bulk else 20)
    lines = path.read_bytes().splitlines(keepends=True)
    good = np.genfromtxt(lines, delimiter=",", skip_header=1)
    lines[5] = b"\x00\xff\xfe garbage\n"  # line 6 of the file
    lines[8] = lines[8].replace(lines[8].split(b",")[3], b"oops")  # current_motor of row 7
    lines[11] = lines[3]  # time goes back
    path.write_bytes(b"".join(lines) + b"3.5,0.1")
    tail = LogTail(path)
    rows = all_rows(tail)
    kept = np.delete(np.arange(len(good)), [4, 10])
    expected = good[kept]
    expected[expected[:, 0] == good[7, 0], 3] = np.nan
    np.testing.assert_allclose(rows, expected, rtol=1e-14)
    told = "\n".join(tail.problems.first)
    assert "line 6: 1 cells instead of 12; left out" in told
    assert "line 9: current_motor: 'oops' is no number" in told
    assert "time does not advance in 1 row; left out" in told and tail.problems.count == 3
    assert tail.torn()


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"1,2,3\n4,5,6\n", "line 1: numbers where the column names should be"),
        (
            b"time,torque\n1,2\n",
            "line 1: column 't' (time in s) is missing; there are time, torque",
        ),
        (b"#\n" * 50_000, "it has no line of column names"),
        (bytes(range(256)) * 20, "column 't' (time in s) is missing"),
    ],
    ids=["no header", "no time", "comments only", "binary"],
)
def test_a_file_that_is_no_log_says_so(tmp_path, data, fault):
    path = tmp_path / "log.csv"
    path.write_bytes(data)
    recording = FollowedLog(path)
    recording.read()
    (told, *_) = recording.complaints()
    assert told.startswith(f"{path}: ") and fault in told
    assert recording.history is None


def test_a_line_without_end_does_not_stop_the_reading(tmp_path):
    path = write_log(tmp_path, 5)
    with path.open("ab") as log:
        log.write(b"x" * 4_500_000 + b"\n9.0" + b",1.0" * 11 + b"\n")
    tail = LogTail(path)
    assert all_rows(tail)[:, 0].tolist() == [*(np.arange(5) / RATE).tolist(), 9.0]
    assert tail.problems.count


def test_another_log_under_the_same_name_is_begun_anew(tmp_path):
    path = write_log(tmp_path, 100)
    recording = FollowedLog(path)
    recording.read()
    path.unlink()
    write_log(tmp_path, 3)
    recording.read()
    recording.read()
    assert recording.history.n_rows == 3


# --- what is kept -------------------------------------------------------------------------


N_LONG = 400_000  # more than six times what is kept as it is


@pytest.fixture(scope="module")
def long():
    """A long history with one spike, its rows, and what it read back from the file."""
    rng = np.random.default_rng(1)
    rows = np.column_stack([np.arange(N_LONG) / RATE, rng.normal(size=N_LONG), np.zeros(N_LONG)])
    rows[123_456, 1], rows[123_456, 2] = 100.0, 4.0
    reads = []

    def read(start, end):
        reads.append(end - start)
        return rows[start:end]  # a byte for each row

    history = History(("t", "torque", "flags"), read)
    for first in range(0, N_LONG, 7001):
        block = rows[first : first + 7001]
        history.add(block, np.arange(first, first + len(block) + 1))
    return history, rows, reads


def test_memory_does_not_grow_with_the_log(long):
    history, rows, _ = long
    arrays = [value for value in vars(history).values() if isinstance(value, np.ndarray)]
    small = History(("t", "torque", "flags"), lambda start, end: rows[start:end])
    before = [value for value in vars(small).values() if isinstance(value, np.ndarray)]
    grown = sum(a.nbytes for a in arrays) - sum(a.nbytes for a in before)
    assert history.n_rows == N_LONG and grown <= 64 * history.bucket
    assert history.span == (0.0, rows[-1, 0])


@settings(max_examples=60, deadline=None)
@given(start=st.floats(-10.0, 500.0), width=st.floats(0.01, 600.0), points=st.integers(50, 900))
def test_a_view_shows_every_extreme_between_its_times(long, start, width, points):
    history, rows, reads = long
    reads.clear()
    view = history.view(start, start + width, points)
    inside = rows[(rows[:, 0] >= start) & (rows[:, 0] <= start + width)]
    assert np.all(np.diff(view.time) > 0.0) and len(view.time) <= 2 * points + 4
    if len(inside):
        assert view.low[:, 1].min() <= inside[:, 1].min()
        assert view.high[:, 1].max() >= inside[:, 1].max()
        assert np.bitwise_or.reduce(view.flags) >= inside[:, 2].max()
        around = rows[(rows[:, 0] >= view.time[0]) & (rows[:, 0] <= view.high[-1, 0])]
        assert view.high[:, 1].max() == around[:, 1].max()
        assert view.low[:, 1].min() == around[:, 1].min()
    if view.step == 1:
        index = np.round(view.time * RATE).astype(int)
        np.testing.assert_array_equal(view.low, rows[index])
    assert sum(reads) <= 200_000


def test_magnified_old_rows_come_from_the_file(long):
    history, rows, reads = long
    reads.clear()
    view = history.view(154.0, 155.0, 500)
    assert view.step == 1 and reads and view.high[:, 1].max() == 100.0
    assert history.at(123_456.4 / RATE).tolist() == rows[123_456].tolist()
    assert history.at(1e9).tolist() == rows[-1].tolist()


def test_what_is_added_to_a_view_is_what_a_later_view_shows():
    rng = np.random.default_rng(2)
    rows = np.column_stack([np.arange(6000) / RATE, rng.normal(size=6000)])
    history = History(("t", "torque"), lambda start, end: rows[start:end])
    history.add(rows[:3000], np.arange(3001))
    view = history.view(0.0, 10.0, 500, to_the_end=False)
    low, high, end = [view.low], [view.high], view.end
    for first in range(3000, 6000, 37):
        history.add(rows[first : first + 37], np.arange(first, min(first + 38, 6001)))
        more = history.since(end, view.step)
        low.append(more.low)
        high.append(more.high)
        end = more.end
    low, high = np.concatenate(low), np.concatenate(high)
    n = 6000 // view.step
    np.testing.assert_array_equal(low[:, 1], rows[: n * view.step, 1].reshape(n, -1).min(axis=1))
    np.testing.assert_array_equal(high[:, 1], rows[: n * view.step, 1].reshape(n, -1).max(axis=1))


def test_a_trigger_stands_at_the_newest_passage_that_is_shown_whole():
    time = np.arange(4000) / RATE
    wave = np.sin(2.0 * np.pi * time)
    noise = 0.01 * np.random.default_rng(3).normal(size=len(time))
    rows = np.column_stack([time, wave + noise])

    def read(start, end):
        assert start <= end, "a file is read forwards"
        return rows[start:end]

    history, columns = History(("t", "torque"), read), ("t", "torque")
    found = {"rises": [], "falls": []}
    triggers = {name: Trigger("torque", 0.5, name == "rises") for name in found}
    for first in range(0, len(rows), 40):
        history.add(rows[first : first + 40], np.arange(first, first + 41))
        for name, trigger in triggers.items():
            if trigger.look(history, columns, 0.5):
                found[name].append(trigger.at)
    assert np.allclose(found["rises"], np.arange(5) + 1.0 / 12.0, atol=0.02)
    assert np.allclose(found["falls"], np.arange(5) + 5.0 / 12.0, atol=0.02)
    late = Trigger("torque", 0.5, rising=True)
    assert not late.look(history, columns, 6.5)
    assert late.look(history, columns, 6.5, ended=True)
    assert late.at == pytest.approx(4.0 + 1.0 / 12.0, abs=0.02)
    assert not late.look(history, columns, 6.5, ended=True), "it stands there"
    lost = Trigger("speed", 0.5, rising=True)
    assert not lost.look(history, columns, 0.5) and lost.text().endswith("0.5: not yet")


# --- which run ----------------------------------------------------------------------------


def record(folder, started, status="completed", **more):
    folder.mkdir(parents=True, exist_ok=True)
    facts = {"status": status, "reason": None, "started": f"2026-01-0{started}T10:00:00.000+00:00"}
    (folder / "run.json").write_text(json.dumps({**facts, **more}))


def watch_until(watch, condition, what):
    def found():
        watch.poll()
        return watch.followed is not None and condition(watch.followed)

    until(found, what, seconds=10)
    return watch.followed


def test_the_newest_run_is_followed(tmp_path):
    watch = Watch(tmp_path / "runs", None)
    assert watch.followed is None
    (tmp_path / "runs" / "notes").mkdir(parents=True)
    write_log(tmp_path / "runs" / "b", 10)
    record(tmp_path / "runs" / "b", 2)
    write_log(tmp_path / "runs" / "z", 20)
    record(tmp_path / "runs" / "z", 1)
    first = watch_until(watch, lambda r: r.history is not None, "the newer of two runs")
    assert first.name == "b" and first.history.n_rows == 10 and not first.state.running
    record(tmp_path / "runs" / "a", 3, "running")
    newest = watch_until(watch, lambda r: r.name == "a", "a run that begins")
    assert newest.state.running and newest.history is None and newest.complaints() == []
    write_log(tmp_path / "runs" / "a", 5)
    watch_until(watch, lambda r: r.history is not None and r.history.n_rows == 5, "its samples")
    record(tmp_path / "runs" / "a", 3, "interlock")
    watch_until(watch, lambda r: r.state.status == "interlock", "its end")


def test_a_malformed_record_hides_no_samples(tmp_path):
    path = write_log(tmp_path, 10)
    (tmp_path / "run.json").write_text("{")
    recording = FollowedLog(path)
    recording.read()
    assert recording.history.n_rows == 10
    (told,) = recording.complaints()
    assert "run.json:1:2: not a readable run record" in told


# --- the command --------------------------------------------------------------------------


def start_scope(*args, cwd):
    """A running ``rig scope`` and the address that it says."""
    process = start_rig("scope", "--no-browser", "--port", 0, *args, cwd=cwd)
    line = process.stdout.readline()
    assert line.startswith("http://127.0.0.1:"), process.communicate()[1]
    return process, line.split()[0]


def test_it_serves_this_machine_only_until_it_is_ended(tmp_path):
    process, address = start_scope(cwd=tmp_path)
    port = urlsplit(address).port
    listens = [
        c.laddr for c in psutil.Process(process.pid).net_connections("inet") if c.status == "LISTEN"
    ]
    assert [(a.ip, a.port) for a in listens] == [("127.0.0.1", port)]
    taken = rig("scope", "--no-browser", "--port", port, cwd=tmp_path)
    assert taken.returncode == 2 and f"--port {port}: cannot be used" in taken.stderr
    process.send_signal(signal.SIGINT)  # Ctrl-C is how a server is meant to end
    _, err = process.communicate(timeout=30)
    assert process.returncode == 0 and err == ""
    with socket.socket() as again:
        again.bind(("127.0.0.1", port))


def test_its_json_has_the_address_with_a_key_that_nobody_guesses(page_address, tmp_path):
    process = start_rig("scope", "--port", 0, "--json", cwd=tmp_path)
    text = ""
    while not text.endswith("}\n"):
        text += process.stdout.readline()
    document = json.loads(text)
    assert document["run"] is None and document["out"] == "runs"
    assert request(document["address"])[0] == 200
    key, another = (urlsplit(each).path.strip("/") for each in (page_address, document["address"]))
    assert len(key) >= 32 and another != key
    process.terminate()
    process.communicate(timeout=30)
    assert process.returncode == 0


@pytest.fixture(scope="module")
def page_address(tmp_path_factory):
    process, address = start_scope(cwd=tmp_path_factory.mktemp("scope"))
    request(address)  # is answered in whole when there are sockets too
    yield address
    process.terminate()
    process.communicate(timeout=30)


@contextlib.contextmanager
def asking(address, path=None, **headers):
    """A plain socket on which a server has been asked for a page."""
    url = urlsplit(address)
    lines = {"Host": url.netloc, **headers}
    head = [f"GET {url.path if path is None else path} HTTP/1.1"]
    head += [f"{name.replace('_', '-')}: {value}" for name, value in lines.items()]
    with socket.create_connection((url.hostname, url.port), timeout=30) as connection:
        connection.sendall("\r\n".join([*head, "", ""]).encode())
        yield connection


def request(address, path=None, **headers):
    """Status and body of what a server answers."""
    with asking(address, path, **headers) as connection:
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        return answer.status, answer.read()


def socket_of(address):
    """Path and headers with which a page's WebSocket is asked for."""
    url = urlsplit(address)
    return {
        "path": f"{url.path}ws",
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec_WebSocket_Protocol": f"bokeh, {generate_jwt_token('any')}",
        "Origin": f"http://{url.netloc}",
    }


def upgrade(address, path=None, **headers):
    """Status of what a server answers to a WebSocket's request."""
    return request(address, **(socket_of(address) | ({"path": path} if path else {}) | headers))


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
def test_the_printed_address_is_answered_under_all_names_of_this_machine(page_address, name):
    host = f"{name}:{urlsplit(page_address).port}"
    status, body = request(page_address, Host=host)
    assert status == 200 and b"rig scope" in body
    assert upgrade(page_address, Host=host, Origin=f"http://{host}")[0] == 101


@pytest.mark.parametrize("knock", [request, upgrade], ids=["page", "socket"])
@pytest.mark.parametrize("wrong", ["no key", "another key", "its beginning", "a path beside it"])
def test_without_the_key_neither_page_nor_socket_is_given(page_address, knock, wrong):
    key = urlsplit(page_address).path.strip("/")
    other = key[:-1] + ("A" if key[-1] != "A" else "B")
    paths = {"no key": "", "another key": f"/{other}", "its beginning": f"/{key[:-1]}"}
    path = paths.get(wrong, f"/x/{key}") + ("/ws" if knock is upgrade else "/")
    status, body = knock(page_address, path)
    assert status == 403
    words = b"there is no page at this address; open the address that rig scope has printed\n"
    assert body == words


@pytest.mark.parametrize("path", ["/metadata", "/autoload.js", "/static/js/bokeh.min.js"])
def test_without_the_key_nothing_else_is_given_either(page_address, path):
    assert request(page_address, path)[0] == 403


@pytest.mark.parametrize("knock", [request, upgrade], ids=["page", "socket"])
@pytest.mark.parametrize(
    "foreign",
    [
        {"Host": "rebound.example:{port}"},
        {"Host": "rebound.example:{port}", "Origin": "http://rebound.example:{port}"},
        {"Origin": "http://rebound.example:{port}"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Origin": "null"},
        {"Host": "127.0.0.1"},
        {"Host": "127.0.0.1:1"},
        {"Host": "127.0.0.1.rebound.example:{port}"},
    ],
    ids=str,
)
def test_another_site_is_refused_even_with_the_key(page_address, knock, foreign):
    port = urlsplit(page_address).port
    headers = {name: text.format(port=port) for name, text in foreign.items()}
    status, body = knock(page_address, **headers)
    assert status == 403
    words = f"this page answers to 127.0.0.1:{port}, localhost:{port}, [::1]:{port} alone; open"
    assert body.startswith(words.encode())


# Loads Bokeh when its input ends.
SLOW = """
import sys
import daq.scope.server
daq.scope.server._load = sys.stdin.read
from daq.cli import main
main()
"""


def test_the_page_says_something_before_bokeh_is_loaded(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, "scope", "--no-browser", "--port", "0"],
        cwd=tmp_path, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    address = process.stdout.readline().split()[0]
    with asking(address) as connection:
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        first = answer.read1()
        assert b"No run under runs yet" in first and b"bokeh.min.js" in first
        assert b"figures are being made" in first
        assert request(f"{address}static/js/bokeh.min.js")[0] == 200
        process.stdin.close()
        assert b"autoload.js" in answer.read()
    with process:
        process.terminate()
    assert process.returncode == 0


# Has more to say than a reader takes who stands still.
FLOOD = """
import daq.scope.pages
from bokeh.models import ColumnDataSource

class Flood:
    def __init__(self, document, watch):
        self.source = ColumnDataSource({"x": []})
        document.add_root(self.source)
        document.add_periodic_callback(self.update, 10)

    def update(self):
        for _ in range(4):
            self.source.data = {"x": ["x" * 10_000_000]}

daq.scope.pages.Page = Flood
from daq.cli import main
main()
"""


@pytest.mark.soak
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_tab_that_does_not_read_leaves_no_word_at_the_end(tmp_path, number):
    process = subprocess.Popen(
        [sys.executable, "-c", FLOOD, "scope", "--no-browser", "--port", "0"],
        cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    address = process.stdout.readline().split()[0]
    request(address)
    with asking(address, **socket_of(address)) as tab, tab.makefile("rb") as stream:
        assert len(stream.read(1_000_000)) == 1_000_000
        process.send_signal(getattr(signal, number))
        _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (0, "")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("missing.csv",), ["missing.csv", "there is no such run"]),
        ((".",), ["holds no run", "--out"]),
    ],
    ids=["missing", "a folder without a run"],
)
def test_a_run_that_is_not_there_is_refused(tmp_path, args, words):
    result = rig("scope", "--no-browser", *args, cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == ""
    assert all(word in result.stderr for word in words) and "Traceback" not in result.stderr


def test_without_bokeh_it_says_how_to_install_it(tmp_path):
    code = "import sys; sys.modules['bokeh'] = None; from daq.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", code, "scope"],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert result.returncode == 2 and "pip install 'hybrid-rig[scope]'" in result.stderr


def test_a_run_is_stopped_as_by_ctrl_c_and_no_other_process_is(tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=300.0)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    with start_rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path) as process:
        folder = until(lambda: next(iter(tmp_path.glob("runs/*/log.csv")), None), "a log").parent
        record = record_of(folder)["process"]
        if sys.platform != "linux":
            return
        another = RunProcess.of({**record, "started": record["started"] + 1})
        assert not another.is_alive() and not another.interrupt()
        until(lambda: rows_in(folder) > 100, "the run itself")
        assert process.poll() is None
        of_run = RunState.of(folder / "log.csv").process
        assert of_run.is_alive() and of_run.interrupt()
        process.communicate(timeout=60)
    document = record_of(folder)
    assert document["status"] == "stopped" and "Ctrl-C" in document["reason"]
    assert not of_run.is_alive() and not of_run.interrupt()


@pytest.mark.parametrize(
    "change",
    [{"pid": 1}, {"pid": "12"}, {"pid": True}, {"stop": 9}, {"stop": None}, {"more": 1}],
)
def test_a_record_that_names_no_process_of_a_run_stops_nothing(change):
    record = {"pid": 1234, "started": 1, "boot": "b", "stop": int(signal.SIGINT)}
    assert RunProcess.of(record) is not None
    assert RunProcess.of({**record, **change}) is None and RunProcess.of(None) is None


def test_a_folder_that_is_not_there_is_not_called_empty(tmp_path):
    assert "rusn yet, nor that folder." in heading(None, tmp_path / "rusn", newer=False)
    assert f"No run under {tmp_path} yet." in heading(None, tmp_path, newer=False)


def test_limits_of_a_record_are_those_of_the_quantities(tmp_path):
    commands = {"motor": [-5, 5], "brake": [0, 1]}
    limits = {"current": {"motor": 2.4, "brake": "x"}, "command": commands}
    record = {"status": "running", "rig": {"limits": {**limits, "speed": 150.0, "travel": None}}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    shown = RunState.of(tmp_path / "log.csv").limits
    assert shown["current_motor"] == [2.4, -2.4] and shown["omega"] == [150.0, -150.0]
    assert shown["voltage_motor"] == [-5.0, 5.0] and shown["voltage_brake"] == [1.0]
    assert "theta" not in shown and "current_brake" not in shown


def test_neighbouring_rows_are_given_from_memory_and_from_the_file(long):
    history, rows, _ = long
    time = rows[:, 0]
    for first, last in ((1000, 1500), (len(rows) - 400, len(rows) - 1)):
        shown = history.rows(time[first], time[last], 300)
        assert np.array_equal(shown[:, 0], time[last - 299 : last + 1])


def test_a_sine_has_its_amplitude_in_the_spectrum_and_gaps_count_as_the_mean():
    t = np.arange(10_000) / 800.0
    values = np.stack([2.0 * np.sin(2 * np.pi * 50.0 * t) + 7.0, np.full(len(t), np.nan)], axis=1)
    values[100:110, 0] = np.nan
    frequency, amplitude = spectra(values, 1.0 / 800.0)
    assert frequency[amplitude[:, 0].argmax()] == pytest.approx(50.0, abs=0.2)
    assert amplitude[:, 0].max() == pytest.approx(2.0, rel=0.02)
    assert not amplitude[:, 1].any() and not len(spectra(values[:10], 0.1)[0])
