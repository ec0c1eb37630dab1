"""Helpers of the daq tests: the ``rig`` command as a process, and the files it reads."""

import atexit
import functools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml

from sim_rig.actuator import actuator

RIG = (sys.executable, "-m", "daq.cli")

# Short, without homing, so that a run takes no longer than the interpreter's start.
EXPERIMENT = {
    "protocol": "prbs",
    "sample_rate": 800,
    "duration": 0.5,
    "calibration": {"samples": 16},
    "motor": {"amplitude": 0.75, "offset": 0.1, "minimum_period": 0.005, "seed": 4},
    "brake": {"amplitude": 0.07, "offset": 0.07, "minimum_period": 0.05, "seed": 5},
}
RIG_FILE = {"name": "test rig", "backend": "simulated", "options": {"seed": 3}}


def file_limit(size):
    """What makes a disk full for a process: its files grow to so many bytes. Not on Windows."""
    import resource

    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def on_terminal(words, folder, columns, program=RIG, **variables):
    """What ``rig`` shows on a terminal so wide, without its colours; variables: environment's."""
    import pty  # not on Windows

    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*program, *map(str, words)], cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs,
        env=environment(COLUMNS=str(columns), TERM="xterm", **variables),
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # whoever wrote there has gone
        while part := os.read(ours, 65536):
            shown += part
    os.close(ours)
    process.wait(60)
    return re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", shown.decode()).replace("\r\n", "\n")


def merged(base, changes):
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        result[key] = merged(old, value) if both else value
    return result


def write_yaml(path, base, **changes):
    path.write_text(yaml.safe_dump(merged(base, changes), sort_keys=False))
    return path


def write_experiment(path, **changes):
    return write_yaml(path, EXPERIMENT, **changes)


def write_rig(path, **changes):
    return write_yaml(path, RIG_FILE, **changes)


OF_LAG = {
    "model": "lag.py:model",
    "population": 16,
    "generations": 2,
    "columns": {
        "time": {"column": "t"},
        "inputs": {"u": {"column": "u"}},
        "outputs": {"y": {"column": "y"}},
    },
}
"""Settings of an identification of a model in lag.py from a table of t, u and y."""


def few_free(*free, **parts):
    """Settings of an identification of the actuator in which only ``free`` are searched.

    The others stand at what the simulated rig has. For tests of something else: intervals of what
    data hardly tell apart, which a whole actuator has many of, cost tens of seconds. parts: of the
    actuator.
    """
    model = actuator(**parts, parameters="rig")
    values = zip(model.parameter_names, model.nominal.tolist(), strict=True)
    free = free or ("R_m", "K_m", "B_m")
    fixed = {name: value for name, value in values if name not in free}
    return {"population": 16, "generations": 2, "seed": 1, "fixed": fixed}


def environment(**extra):
    """The environment of a test process: neutral colours, and warnings are errors."""
    env = {k: v for k, v in os.environ.items() if k not in {"FORCE_COLOR", "COLUMNS"}}
    return {**env, "PYTHONWARNINGS": "error", "NO_COLOR": "1", **extra}


def _words(args, report):
    """Arguments as text; without the figures of a report, which few tests need for their time."""
    words = list(map(str, args))
    identifies = words[:1] == ["identify"] or "--identify" in words
    return [*words, "--no-report"] if identifies and not report else words


def rig(*args, cwd, env=None, timeout=120, report=False, fresh=False, **options):
    """Run ``rig`` to its end; a CompletedProcess with text output.

    env: further variables. fresh: by an interpreter of its own, which costs seconds, as do options
    of ``subprocess.run``.
    """
    words = _words(args, report)
    if not fresh and not options and hasattr(os, "fork"):
        return _shared_server().run(words, cwd, timeout, env)
    return subprocess.run(
        [*RIG, *words],
        cwd=cwd,
        env=environment(**(env or {})),
        capture_output=True,
        encoding="utf-8",
        timeout=timeout,
        check=False,
        **options,
    )


def start_rig(*args, cwd, env=None, **options):
    """Start ``rig`` and leave it running: a Popen, or a Started where no options ask for more."""
    words = _words(args, report=False)
    if not options and hasattr(os, "fork"):
        return _shared_server().start(words, cwd, env)
    begin = _Breakable if sys.platform == "win32" else subprocess.Popen
    return begin(
        [*RIG, *words],
        cwd=cwd,
        env=environment(**(env or {})),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        **options,
    )


class _Breakable(subprocess.Popen):
    """A process of Windows, where Ctrl-Break is what one can send to another, and hears alone."""

    def __init__(self, *args, **options):
        super().__init__(*args, creationflags=subprocess.CREATE_NEW_PROCESS_GROUP, **options)

    def send_signal(self, number):
        super().send_signal(signal.CTRL_BREAK_EVENT if number == signal.SIGINT else number)


# Prepares what the commands need, then becomes a ``rig`` process per line of standard input.
_FORKING = """
import gc, importlib.metadata, json, os, signal, sys, traceback
import daq.cli, daq.cli.app, daq.figures.findings, daq.identification.comparison
import daq.identification.fit, daq.identification.replay, daq.recording.preview, daq.serial.backend
import matplotlib.figure, numba, pandas, pint, pydantic.type_adapter, rich.progress, rich.table
import scipy.interpolate, sim_rig.actuator, sim_rig.backend, sysid.engine.parts
import sysid.engine.phi, sysid.gassi, sysid.judging.alternatives
for protocol in importlib.metadata.entry_points(group="rig.protocols"):
    protocol.load()
daq.config.units.factor("rpm", "rad/s")
numba.njit("f8(f8)")(lambda x: x)  # what the first compilation of a process takes half a second for
gc.freeze()  # so that no child looks through, and copies, what all share

for line in sys.stdin:
    job = json.loads(line)
    if "ended" in job:
        child, status = os.waitpid(job["ended"], os.WNOHANG)
        print(os.waitstatus_to_exitcode(status) if child else "", flush=True)
        continue
    # Before it is there: whoever reads what it says finds it open.
    streams = [os.open(job[name], os.O_WRONLY | os.O_CREAT) for name in ("out", "err")]
    child = os.fork()
    if child == 0:
        # As in a terminal, whatever the tests themselves were started from.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for name in ("SIGTERM", "SIGHUP"):
            signal.signal(getattr(signal, name), signal.SIG_DFL)
        signal.alarm(job["timeout"])
        os.environ.clear()
        os.environ.update(job["env"])
        sys.path[:0] = filter(None, job["env"].get("PYTHONPATH", "").split(os.pathsep))
        os.chdir(job["cwd"])
        for number, stream in enumerate((os.open(os.devnull, os.O_RDWR), *streams)):
            os.dup2(stream, number)
            os.close(stream)
        sys.argv = ["rig", *job["args"]]
        status = 0
        try:
            daq.cli.main()
        except SystemExit as end:
            status = end.code or 0
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    for stream in streams:
        os.close(stream)
    waits = job["timeout"] > 0
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) if waits else child, flush=True)
"""


class Started:
    """A ``rig`` process that runs, with what tests use of a Popen of texts."""

    def __init__(self, server, pid, out, err):
        self._server, self.pid, self.returncode = server, pid, None
        self.stdout, self.stderr = out, err

    def poll(self):
        if self.returncode is None:
            self.returncode = self._server.status(self.pid)
        return self.returncode

    def wait(self, timeout=None):
        deadline = time.perf_counter() + (timeout or 1e9)
        while self.poll() is None:
            if time.perf_counter() > deadline:
                raise subprocess.TimeoutExpired("rig", timeout)
            time.sleep(0.005)
        return self.returncode

    def communicate(self, timeout=None):
        """Rest of its output and of its errors, which others than it may hold open."""
        readers = [ThreadPoolExecutor(1) for _ in range(2)]
        pipes = self.stdout, self.stderr
        texts = [pool.submit(pipe.read) for pool, pipe in zip(readers, pipes, strict=True)]
        try:
            out, err = (text.result(timeout) for text in texts)
        except TimeoutError:
            raise subprocess.TimeoutExpired("rig", timeout) from None
        self.__exit__()
        return out, err

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stdout.close()
        self.stderr.close()
        self.wait()


class _Server:
    """``rig`` processes without the seconds that each needs for its imports."""

    def __init__(self):
        self._lock = threading.Lock()
        self._folder = tempfile.TemporaryDirectory()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _FORKING],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
        )  # fmt: skip

    def run(self, words, cwd, timeout=120, env=None):
        out, err = Path(self._folder.name) / "out", Path(self._folder.name) / "err"
        out.unlink(missing_ok=True)
        err.unlink(missing_ok=True)
        status = int(self._answer(words, cwd, env, out, err, timeout))
        assert status != -signal.SIGALRM, f"rig {words} has not ended within {timeout} s"
        return subprocess.CompletedProcess(
            words, status, out.read_text("utf-8"), err.read_text("utf-8")
        )

    def start(self, words, cwd, env=None):
        """Begin one and leave it running: a Started, whose pipes are named for a moment."""
        with tempfile.TemporaryDirectory() as folder:
            pipes = [Path(folder) / name for name in ("out", "err")]
            for pipe in pipes:
                os.mkfifo(pipe)
            # Not to wait for who writes to it, which comes with the answer.
            ends = [os.open(pipe, os.O_RDONLY | os.O_NONBLOCK) for pipe in pipes]
            pid = int(self._answer(words, cwd, env, *pipes, 0))
        for end in ends:
            os.set_blocking(end, True)
        return Started(self, pid, *[os.fdopen(end, encoding="utf-8") for end in ends])

    def status(self, pid):
        """How a process has ended, None while it runs."""
        answer = self._ask({"ended": pid})
        return int(answer) if answer else None

    def _answer(self, words, cwd, env, out, err, timeout):
        job = {"args": words, "cwd": str(cwd), "out": str(out), "err": str(err)}
        return self._ask(job | {"env": environment(**(env or {})), "timeout": timeout})

    def _ask(self, job):
        with self._lock:
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
            return self._process.stdout.readline().strip()

    def close(self):
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self._folder.cleanup()


@functools.cache
def _shared_server():
    server = _Server()
    atexit.register(server.close)
    return server


@contextmanager
def forked_rig(**env):
    """A function of arguments and folder that runs ``rig``; env: further variables.

    Its result is a CompletedProcess.
    """
    if not hasattr(os, "fork"):
        yield lambda args, cwd, report=False: rig(*args, cwd=cwd, env=env, report=report)
        return
    server = _shared_server()
    yield lambda args, cwd, report=False: server.run(_words(args, report), cwd, env=env)


def until(condition, what, seconds=60.0, every=0.005):
    """Poll until ``condition`` gives something true, and return it."""
    deadline = time.perf_counter() + seconds
    while time.perf_counter() < deadline:
        result = condition()
        if result:
            return result
        time.sleep(every)
    raise AssertionError(f"not within {seconds:g} s: {what}")


def only_capture(root):
    """The one capture folder under ``root``/runs."""
    (folder,) = sorted(p for p in (Path(root) / "runs").iterdir() if p.is_dir())
    return folder


def record_of(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def rows_in(folder):
    """Complete data rows in a log, also in one that is being written."""
    path = folder / "log.csv"
    return max(0, path.read_bytes().count(b"\n") - 1) if path.exists() else 0


def run_in_progress(root, rows=50, start=None, env=None):
    """A run of e.yaml on rig.yaml in real time, and its folder once it holds ``rows`` rows.

    A computer that is too busy to keep pace ends a run by itself: then it is begun again. start:
    what begins it, another process than ``start_rig``'s.
    """
    begin = start or (lambda: start_rig("run", "e.yaml", "--rig", "rig.yaml", cwd=root, env=env))
    for _ in range(3):
        process = begin()

        def begun(process=process):
            folders = (Path(root) / "runs").glob("*")
            folder = next((folder for folder in folders if rows_in(folder) >= rows), None)
            return folder or process.poll() is not None

        try:
            folder = until(begun, f"a log with {rows} rows under {root}, or an end")
        except BaseException:
            process.kill()
            print(*process.communicate())
            raise
        if process.poll() is None:
            return process, folder
        said = process.communicate()
        shutil.rmtree(Path(root) / "runs", ignore_errors=True)
    raise AssertionError(f"three runs ended by themselves: {said}")


# A backend of its own distribution, as a lab would install one: the simulated rig with faults
# on demand. Everything it is asked is written to a journal, one JSON line each.
_FAULTY = '''
"""The simulated rig with faults on demand and a journal of what it was asked."""
import dataclasses
import json
import time
from pathlib import Path

from daq.errors import DeviceError
from daq.hal import Flag, Mode
from sim_rig.backend import SimulatedDevice, Simulation


class Options(Simulation):
    journal: str
    fault: str = ""
    at: int = 0


class FaultyDevice(SimulatedDevice):
    Options = Options

    def __init__(self, options):
        super().__init__(options)
        self._path = Path(options.journal)
        self._exciting = self._receiving = False

    def note(self, what, **facts):
        with self._path.open("a") as journal:
            journal.write(json.dumps({"what": what, "at": time.perf_counter(), **facts}) + "\\n")

    def start(self, sample_rate, mode, guard):
        self._exciting = mode is Mode.OPEN_LOOP
        self.note("start", mode=mode.value)
        super().start(sample_rate, mode, guard)

    def announce(self, phase, turns=0.0):
        self.note("announce", phase=phase.value)
        if self.options.fault != "no hand":
            super().announce(phase, turns)

    def receive(self):
        self._receiving = True
        try:
            raw = super().receive()
        finally:
            self._receiving = False
        fault, at = self.options.fault, self.options.at
        if self._exciting and raw.tick[-1] >= at:
            if fault == "unplugged":
                raise DeviceError("the device no longer answers; check its cable")
            if fault == "bug":
                raise ZeroDivisionError("a mistake in the backend")
            if fault == "own interlock":
                raw.flags[raw.tick == at] |= int(Flag.INTERLOCK)
                raw.applied[raw.tick >= at] = 0.0
                super().safe()
            if fault == "lost":
                keep = (raw.tick < at) | (raw.tick >= at + 10)
                raw = self._only(raw, keep)
            if fault == "lost to the end":
                keep = raw.tick < at
                if not keep.any():
                    keep[-1] = True
                    raw.tick[-1] += 1_000_000
                raw = self._only(raw, keep)
        self.note("receive", until=int(raw.tick[-1]), applied=raw.applied[-1].tolist())
        return raw

    def _only(self, raw, keep):
        fields = [field.name for field in dataclasses.fields(raw)]
        return dataclasses.replace(raw, **{name: getattr(raw, name)[keep] for name in fields})

    def safe(self):
        super().safe()
        if hasattr(self, "_path"):
            self.note("safe")
            if self._running and not self._receiving:
                # What the outputs are now, by the device's own account.
                self.note("outputs", applied=super().receive().applied.ravel().tolist())

    def close(self):
        super().close()
        self.note("close")
        if self.options.fault == "unplugged" and self.options.at > 0:
            raise DeviceError("cannot disconnect: the device is gone")
'''


def install_faulty(folder):
    """Make the backend ``faulty`` importable and registered from ``folder`` on PYTHONPATH."""
    return install(folder, "faulty_backend", _FAULTY, "rig.backends", "faulty", "FaultyDevice")


def install(folder, module, text, group, name, attribute):
    """A distribution with one entry point in ``folder``; the environment that finds it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{module}.py").write_text(text)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}:{attribute}\n")
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(paths)}


def journal_of(path):
    return [json.loads(line) for line in Path(path).read_text("utf-8").splitlines()]


SLIDE = """
from sysid import Input, Output, Parameter, ProcessModel, State

model = ProcessModel(
    name="slide",
    states=(State("x", "m"), State("v", "m/s")),
    inputs=(Input("F", "N"),),
    outputs=(Output("x", "m"),),
    parameters=(Parameter("friction", "N*s/m", 2.0, 0.2, 20.0, "log"),),
    derivative=lambda x, u, p: (x[1], (u[0] - p[0] * x[1]) / 0.5),
)
"""


def slide_model(folder):
    """A file with a mass on a slide, of which the position is measured; its name as a model."""
    (folder / "slide.py").write_text(SLIDE)
    return f"{folder / 'slide.py'}:model"


def slide_log(friction):
    """Its log, the first sample 20 mm off.

    Velocity in closed form: it relaxes towards F / friction by exp(-friction t / mass).
    """
    import numpy as np
    import pandas as pd

    rng, dt = np.random.default_rng(4), 0.02
    force = np.repeat(rng.uniform(-2.0, 2.0, 30), 10)
    decay, x, v, rows = np.exp(-friction * dt / 0.5), 0.0, 0.0, []
    for f in force:
        rows.append(x)
        x += f / friction * dt + (v - f / friction) * (1.0 - decay) * 0.5 / friction
        v = f / friction + (v - f / friction) * decay
    noisy = np.array(rows) + 0.01 * rng.standard_normal(len(rows))
    noisy[0] += 0.02
    return pd.DataFrame({"t": dt * np.arange(len(rows)), "F": force, "x": noisy})
