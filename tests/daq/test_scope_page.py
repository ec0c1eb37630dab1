"""The scope's page in a real browser: headless Chromium, where it and its driver are installed."""

import contextlib
import functools
import shutil
import signal

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

from daq.hal import Flag
from daq.logs.capture import Capture
from daq.logs.recording import load
from daq.logs.writer import LogWriter
from tests.daq import support
from tests.daq.support import start_rig, write_experiment, write_rig
from tests.daq.test_scope import RATE, samples, start_scope

# Each look at the page is work for three processes.
until = functools.partial(support.until, every=0.05)
_BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
_DRIVER = shutil.which("chromedriver")
pytestmark = [
    pytest.mark.soak,
    pytest.mark.skipif(
        not (_BROWSER and _DRIVER),
        reason="needs Chromium and its driver (Debian: apt install chromium chromium-driver)",
    ),
]

# Finds an element by CSS also inside Bokeh's shadow trees.
_FIND = """
const find = (root) => {
  for (const e of root.querySelectorAll('*')) {
    if (e.matches(arguments[0])) return e
    const inside = e.shadowRoot ? find(e.shadowRoot) : null
    if (inside) return inside
  }
  return null
}
return find(document)
"""


@pytest.fixture(scope="module")
def chromium():
    options = webdriver.ChromeOptions()
    options.binary_location = _BROWSER
    # CI runs as root in a container, where Chromium's sandbox cannot work.
    arguments = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu")
    for argument in (*arguments, "--window-size=1300,1200"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(options=options, service=Service(_DRIVER)) as driver:
        driver.set_script_timeout(30)
        yield driver


class Tab:
    """What a person at the page sees and does."""

    def __init__(self, driver):
        self.driver = driver

    def model(self, name, expression):
        return self.driver.execute_script(
            f"const m = Bokeh.documents[0]?.get_model_by_name('{name}'); return m && {expression}"
        )

    def head(self):
        return self.model("head", "m.text") or ""

    def drawn(self, column="t"):
        values = self.model("samples", f"Array.from(m.data['{column}'] ?? [])") or []
        return np.array([value for value in values if value is not None])

    def flags(self):
        return self.model("flags", "[Array.from(m.data.time), Array.from(m.data.flag)]")

    def values(self):
        """The table beside the figures, by channel."""
        names, values = self.model("values", "[m.data.channel ?? [], m.data.value ?? []]")
        return dict(zip(names, values, strict=True))

    def time(self):
        return tuple(self.model("time", "[m.start, m.end]"))

    def height(self, quantity):
        """The lowest and the highest value that a figure has room for."""
        return tuple(self.model(f"figure of {quantity}", "[m.y_range.start, m.y_range.end]"))

    def button(self):
        return self.model("pause", "m.label")

    def find(self, css):
        return until(lambda: self.driver.execute_script(_FIND, css), f"{css} on the page")

    def press(self):
        self.find(".bk-btn").click()

    def canvas(self):
        """The first figure's drawing area."""
        return self.find(".bk-canvas-events, .bk-events")

    def errors(self):
        return [e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"]


@pytest.fixture
def scope(chromium, tmp_path):
    """Opens a scope over ``tmp_path``; gives the tab."""
    with contextlib.ExitStack() as ending:

        def start(*args):
            process, address = start_scope(*args, cwd=tmp_path)

            def end():
                chromium.get("about:blank")
                process.send_signal(signal.SIGTERM)
                _, errors = process.communicate(timeout=30)
                assert (process.returncode, errors) == (0, "")

            ending.callback(end)
            chromium.get_log("browser")
            chromium.get(address)
            tab = Tab(chromium)
            until(tab.head, "the page")
            return tab

        yield start


@contextlib.contextmanager
def recording(root, name, **facts):
    """A run that the test itself records; gives its folder and log."""
    capture = Capture.create(root / "runs", name, facts)
    with LogWriter(capture.log_path) as log:
        yield capture, log
    capture.finish("completed", None)


def test_it_follows_a_run_of_the_rig_from_its_beginning_to_its_end(scope, tmp_path):
    tab = scope()
    assert "No run under runs yet, nor that folder" in tab.head()
    write_experiment(tmp_path / "e.yaml", duration=300.0)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    with start_rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path) as process:
        shown = until(lambda: tab.drawn().tolist(), "the first samples")
        until(lambda: ">recording<" in tab.head() and "test rig" in tab.head(), "the run's state")
        until(lambda: tab.drawn()[-1] > shown[-1] + 0.5, "half a second more of samples")
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    until(lambda: ">stopped<" in tab.head(), "the run's end")
    assert "stopped by hand (Ctrl-C, or Stop in the scope) during run" in tab.head()
    (folder,) = (tmp_path / "runs").iterdir()
    log = load(folder / "log.csv").frame
    last = log["t"].iloc[-1]
    until(lambda: tab.time() == (0.0, last) and tab.drawn()[-1] > last - 0.3, "the whole run")
    for column in ("current_motor", "omega", "applied_voltage_brake"):
        assert tab.drawn(column).min() == log[column].min()
        assert tab.drawn(column).max() == log[column].max()
    until(lambda: tab.values().get("tick") == str(log["tick"].iloc[-1]), "the newest values")
    assert float(tab.values()["theta"]) == pytest.approx(log["theta"].iloc[-1], rel=1e-5)
    loaded = tab.driver.execute_script(
        "return performance.getEntriesByType('resource').map(e => new URL(e.name).hostname)"
    )
    assert set(loaded) == {"127.0.0.1"} and not tab.errors()


def test_channels_views_and_the_stop_button_in_a_narrow_window(scope, tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=300.0)
    write_rig(tmp_path / "rig.yaml", options={"time": "real"})
    tab = scope()
    with contextlib.ExitStack() as ending:
        run = start_rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
        process = ending.enter_context(run)
        ending.callback(process.terminate)
        until(lambda: len(tab.drawn()) > 50, "the first samples")
        tab.driver.set_window_size(600, 1000)
        limits = tab.model("limits of current_motor", "Array.from(m.data_source.data.y)")
        assert limits[0] == -limits[1] > 0.0
        tab.model("channels", "(m.active = [4])")
        names = "m.children[0].children.map((child) => child[0].name)"
        torque = ["figure of torque"]
        until(lambda: tab.model("figures", names) == torque, "the torque alone")
        tab.model("view", "(m.active = 1)")
        until(lambda: tab.model("xy", "m.data.x.length > 100"), "torque over speed")
        tab.model("view", "(m.active = 3)")
        until(lambda: tab.model("spectra", "m.data.torque?.length > 10"), "the spectrum of torque")
        wide = tab.driver.execute_script("return document.documentElement.scrollWidth")
        assert wide <= 600 and not tab.errors()
        until(lambda: tab.model("stop", "m.visible"), "the stop button")
        tab.find(".bk-btn-danger").click()
        process.communicate(timeout=60)
    until(lambda: "stopped by hand" in tab.head(), "the run's end")
    until(lambda: not tab.model("stop", "m.visible"), "no button for what has ended")
    tab.driver.set_window_size(1300, 1200)


def test_a_paused_page_stands_still_until_it_is_let_go_on(scope, tmp_path):
    with recording(tmp_path, "first") as (_, log):
        log.append(samples(400))
        tab = scope()
        until(lambda: len(tab.drawn()) == 400, "the first samples")
        tab.press()
        until(lambda: tab.button() == "Live", "the pause")
        before = tab.time(), tab.drawn()[-1]
        log.append(samples(400, first=400))
        # The heading goes on: half of the samples were there when it was paused.
        until(lambda: "100 %" in tab.head() or tab.values().get("tick") == "799", "new samples")
        assert (tab.time(), tab.drawn()[-1]) == before
        tab.press()
        until(lambda: tab.drawn()[-1] == 799 / RATE, "what came meanwhile")
        tab.press()
        until(lambda: tab.button() == "Live", "another pause")
    with recording(tmp_path, "second") as (capture, log):
        log.append(samples(50))
        until(lambda: "A new run has begun" in tab.head(), "the notice")
        assert "first" in tab.head()
        tab.press()
        until(lambda: capture.folder.name in tab.head(), "the new run")
        until(lambda: len(tab.drawn()) == 50, "its samples")
    with recording(tmp_path, "third") as (capture, log):
        until(lambda: capture.folder.name in tab.head(), "a run that began while it was live")
        assert len(tab.drawn()) == 0 and "waiting for the first sample" in tab.head()


def test_a_trigger_holds_where_it_is_and_earlier_runs_lie_behind(scope, tmp_path):
    n, period = 1600, 400  # two seconds of a sine of 2 Hz
    sine = np.sin(2.0 * np.pi * (np.arange(n) - 100) / period)
    with recording(tmp_path, "earlier") as (earlier, log):
        log.append(samples(n, torque=5.0 * sine))
    with recording(tmp_path, "later") as (later, log):
        log.append(samples(n, torque=sine))
        tab = scope(later.folder, earlier.folder)
        behind = "m.renderers.map((r) => Array.from(r.data_source.data.torque ?? []))[0]"
        until(lambda: len(tab.model("figure of torque", behind) or []) > 500, "the earlier run")
        assert max(tab.model("figure of torque", behind)) == pytest.approx(5.0)
        until(lambda: f"behind it: {earlier.folder.name}" in tab.head(), "word of it")
        until(lambda: tab.height("torque")[1] > 5.0, "room for both")
        assert tab.driver.execute_script("return document.getElementById('first')") is None
        tab.model("behind", "(m.value = [])")
        count = "m.renderers.filter((r) => r.name == 'curve behind').length"
        until(lambda: tab.model("figure of torque", count) == 0, "the later run alone")
        tab.model("window", "(m.active = 0)")  # 0.2 s
        tab.model("trigger channel", "(m.value = 'torque')")
        tab.model("level", "(m.value = 0.5)")
        tab.model("edge", "(m.active = 1)")
        # The last rise through 0.5 of which what follows for 0.16 s is there.
        rises = np.flatnonzero((sine[1:] >= 0.5) & (sine[:-1] < 0.5)) + 1
        at = rises[rises / RATE + 0.16 < (n - 1) / RATE][-1] / RATE
        until(lambda: tab.time() == pytest.approx((at - 0.04, at + 0.16)), "the trigger")
        word = "trigger: torque rises through 0.5 N*m: last at"
        until(lambda: word in tab.head(), "the heading, which is written twice a second")
        assert tab.model("lines", "m.data.time") == [at]
        assert tab.model("level of the trigger", "Array.from(m.data_source.data.y)") == [0.5]
        tab.model("once", "(m.active = true)")
        until(lambda: tab.button() == "Live", "the page to hold")
        log.append(samples(n, first=n, torque=sine))
        until(lambda: tab.values().get("tick") == str(2 * n - 1), "data that go on")
        assert tab.time() == pytest.approx((at - 0.04, at + 0.16))
        tab.press()
        until(lambda: tab.time()[0] > at, "the next time")
        assert tab.button() == "Live" and not tab.errors()


def test_a_finished_run_is_shown_whole_and_magnified_to_its_samples(scope, tmp_path):
    n = 100_000  # more than is kept as it is
    torque = np.sin(np.arange(n) / 5000.0)
    torque[30_000] = 9.0
    flags = np.zeros(n, dtype=int)
    flags[30_000], flags[60_000] = int(Flag.SATURATED), int(Flag.LOST)
    block = samples(n, torque=torque, flags=flags)
    with recording(tmp_path, "long") as (capture, log):
        log.append(block)
    tab = scope(capture.folder)
    until(lambda: len(t := tab.drawn()) and t[-1] > 124.0, "the whole run")
    until(lambda: tab.values().get("t") == repr((n - 1) / RATE), "all digits of the time")
    assert len(tab.drawn()) < 2100  # light, and yet the spike of one sample is there
    assert tab.drawn("torque").max() == 9.0 and tab.time() == (0.0, (n - 1) / RATE)
    assert 9.0 < tab.height("torque")[1] < 11.0
    times, names = tab.flags()
    assert names == ["lost", "saturated"]
    assert tab.model("lines", "[m.data.time, m.data.color]") == [[times[0]], ["#D55E00"]]
    assert times == pytest.approx([60_000 / RATE, 30_000 / RATE], abs=0.2)

    canvas = tab.canvas()
    width = canvas.size["width"]
    drag = ActionChains(tab.driver).move_to_element_with_offset(canvas, -width // 5, 0)
    drag.click_and_hold().move_by_offset(width // 8, 0).release().perform()
    start, end = until(lambda: t if (t := tab.time())[1] < 90.0 else None, "a stretch of time")
    assert 0.0 < start < 30_000 / RATE < end
    until(lambda: tab.button() == "Live", "the pause")
    origin = ScrollOrigin.from_element(canvas)
    ActionChains(tab.driver).scroll_from_origin(origin, 0, -200).perform()
    narrower = until(lambda: t if np.ptp(t := tab.time()) < end - start else None, "the wheel")
    drag = ActionChains(tab.driver).move_to_element_with_offset(canvas, 0, 0)
    drag.click_and_hold().move_by_offset(width // 20, 0).release().perform()
    until(lambda: np.ptp(tab.time()) < 0.1 * np.ptp(narrower), "a second")
    start, end = tab.time()
    until(lambda: len(t := tab.drawn()) and np.diff(t).max() < 1.01 / RATE, "single samples")
    drawn, shown = tab.drawn(), tab.drawn("omega")
    assert drawn[0] <= start + 1 / RATE and drawn[-1] >= end - 1 / RATE
    np.testing.assert_array_equal(shown, block.omega[np.round(drawn * RATE).astype(int)])
    bottom, top = tab.height("torque")
    visible = block.torque[np.round(drawn * RATE).astype(int)]
    assert bottom < visible.min() and visible.max() < top < visible.max() + 0.5 * np.ptp(visible)
    tab.find(".bk-tool-icon-reset").click()
    until(lambda: tab.time() == (0.0, (n - 1) / RATE), "the whole run again")
    until(lambda: tab.height("torque")[1] > 9.0, "its height")


def test_the_values_are_those_under_the_cursor_and_from_the_mark(scope, tmp_path):
    block = samples(800)
    with recording(tmp_path, "short") as (capture, log):
        log.append(block)
    tab = scope(capture.log_path)
    until(lambda: len(tab.drawn()) == 800, "the run")
    assert tab.values()["tick"] == "799" and "newest sample" in tab.values().values()
    canvas = tab.canvas()
    ActionChains(tab.driver).move_to_element_with_offset(canvas, 0, 0).click().perform()
    until(lambda: "at the cursor" in tab.values().values(), "the cursor")
    marked = int(tab.values()["tick"])
    assert 300 < marked < 500
    until(lambda: tab.model("lines", "m.data.time"), "the mark")
    assert tab.model("lines", "m.data.time") == pytest.approx([marked / RATE], abs=1 / RATE)
    ActionChains(tab.driver).move_to_element_with_offset(canvas, 100, 0).perform()
    until(lambda: int(tab.values()["tick"]) > marked + 10, "the cursor elsewhere")
    row = int(tab.values()["tick"])
    assert float(tab.values()["omega"]) == pytest.approx(block.omega[row], rel=1e-5)
    names, differences = tab.model("values", "[m.data.channel, m.data.difference]")
    difference = float(differences[names.index("omega")])
    assert difference == pytest.approx(block.omega[row] - block.omega[marked], rel=1e-4)


def test_a_broken_log_shows_what_is_readable_and_says_what_is_not(scope, tmp_path):
    with recording(tmp_path, "broken") as (capture, log):
        log.append(samples(100))
    lines = capture.log_path.read_bytes().splitlines(keepends=True)
    lines[40] = b"\x00\x00<b>garbage</b>\n"
    capture.log_path.write_bytes(b"".join(lines)[:-9])
    (capture.folder / "run.json").write_text('{"status": "interlock", "reason": "too much <i>"}')
    tab = scope()
    until(lambda: len(tab.drawn()) == 98, "the readable samples")
    until(lambda: "its last line was cut" in tab.head(), "the torn line")
    assert "line 41: 1 cells instead of 12; left out" in tab.head()
    assert ">interlock<" in tab.head() and "too much &lt;i&gt;" in tab.head()


def test_a_log_of_the_original_program_is_shown(scope, tmp_path):
    names = ("t", "cmd_voltage_motor", "cmd_voltage_brake", "current_motor", "current_brake")
    names = (*names, "torque", "theta", "omega")
    rows = [", ".join([f"{k / 800!r}", *["0.5"] * 7]) for k in range(100)]
    path = tmp_path / "old.csv"
    path.write_text("")
    tab = scope(path)
    until(lambda: "no sample in this log yet" in tab.head(), "word of an empty log")
    path.write_text("\n".join([", ".join(names), *rows]) + "\n")
    until(lambda: len(tab.drawn()) == 100, "the log")
    assert "log without a run record" in tab.head() and "&#9888;" not in tab.head()
    path.write_text("a,b\n1,2\n")  # another file in its place, and no log
    until(lambda: "column &#x27;t&#x27; (time in s) is missing" in tab.head(), "what is wrong")
    assert not tab.errors()
