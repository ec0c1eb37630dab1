from __future__ import annotations

import multiprocessing
import os
import runpy
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sysid.engine.compiler import compiled_text, kernels, tangents
from sysid.examples import lag
from tests.soak import mostly_soak

PREFIX = """
import os
import numpy as np
from sysid import Input, Output, Parameter, ProcessModel, State, Stepper
"""

MODEL = """
import math
import shared
from shared import scaled

FACTOR = np.array([1.0, 0.25])

def make(shift):
    def derivative(x, u, p):
        return (scaled(u[0]) * FACTOR[1] - p[0] * (x[0] - shift) + shared.OFFSET,)
    return derivative

model = ProcessModel(
    "cached", (State("y", "1"),), (Input("u", "1"),), (Output("y", "1"),),
    (Parameter("p", "1", 1.0, 0.5, 2.0),), make(0.125),
)
stepper = Stepper(model, np.ones(1), 0.1, n_steps=4)
if "NAME_ONLY" not in os.environ:
    x = np.zeros(1)
    stepper.advance(x, np.ones((20, 1)))
    print(repr(float(x[0])))
"""

SHARED = """
OFFSET = 0.5

def scaled(value):
    return 2.0 * value
"""


def _run_as_script(folder: Path, env: dict[str, str]) -> None:
    """In a process of its own: ``user.py``, with what it says in the files out and err."""
    os.environ.clear()
    os.environ.update(env)
    os.chdir(folder)
    sys.path[:0] = env["PYTHONPATH"].split(os.pathsep)
    sys.dont_write_bytecode = True
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    warnings.simplefilter("error")
    runpy.run_path("user.py", run_name="__main__")
    sys.stdout.flush()


class Workshop:
    """A user's folder with a model file, a helper file and a cache folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cache = folder / "cache"
        (folder / "shared.py").write_text(SHARED)
        (folder / "user.py").write_text(PREFIX + MODEL)
        self.env = os.environ | {
            "RIG_CACHE_DIR": str(self.cache),
            "PYTHONPATH": os.pathsep.join([str(folder), str(Path.cwd())]),
            "PYTHONDONTWRITEBYTECODE": "1",
        }

    def start(self, warnings: str = "error", **env: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-W", warnings, "user.py"],
            cwd=self.folder, env=self.env | env, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def tried(self, **env: str) -> tuple[int | None, str, str]:
        """Status, output and errors of a process that has its packages from one that waits.

        An interpreter of its own would take more than a second to import them.
        """
        if "forkserver" not in multiprocessing.get_all_start_methods():
            process = self.start(**env)
            out, err = process.communicate(timeout=120)
            return process.returncode, out, err
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["sysid.engine.phi", "sysid.engine.parts", "sysid"])
        child = context.Process(target=_run_as_script, args=(self.folder, self.env | env))
        child.start()
        child.join(120)
        out, err = ((self.folder / name).read_text("utf-8") for name in ("out", "err"))
        return child.exitcode, out, err

    def run(self, **env: str) -> float:
        return self.result(*self.tried(**env))

    def run_alone(self, **env: str) -> float:
        """By an interpreter of its own."""
        return self.ended(self.start(**env))

    def ended(self, process: subprocess.Popen[str]) -> float:
        out, err = process.communicate(timeout=120)
        return self.result(process.returncode, out, err)

    @staticmethod
    def result(status: int | None, out: str, err: str) -> float:
        assert status == 0, err
        return float(out or "nan")

    def edit(self, name: str, old: str, new: str) -> None:
        path = self.folder / name
        text = path.read_text("utf-8")
        assert old in text
        path.write_text(text.replace(old, new))

    def kernels(self) -> set[Path]:
        return set(self.cache.glob("*.py"))

    def files(self) -> dict[Path, tuple[int, int]]:
        found = [p for p in self.cache.rglob("*") if p.is_file()]
        return {p: (p.stat().st_size, p.stat().st_mtime_ns) for p in found}


@pytest.fixture
def workshop(tmp_path):
    return Workshop(tmp_path)


def settled(drive, rate=1.0, steps=19, dt=0.1):
    """y' = drive - rate y from 0, exactly."""
    import math

    return drive / rate * (1.0 - math.exp(-rate * steps * dt))


# drive = 2 u FACTOR[1] + p shift + OFFSET
BEFORE = 2.0 * 0.25 + 0.125 + 0.5


CHANGES = {
    "equation": ("user.py", "- p[0] * (x", "+ 0.5 - p[0] * (x"),
    "closure constant": ("user.py", "make(0.125)", "make(0.25)"),
    "array": ("user.py", "[1.0, 0.25]", "[1.0, 0.2500000001]"),
    "helper": ("shared.py", "2.0 * value", "4.0 * value"),
    "constant in a module": ("shared.py", "OFFSET = 0.5", "OFFSET = 0.75"),
}


@pytest.mark.soak
def test_every_kind_of_change_gets_a_kernel_of_its_own(workshop):
    """One after another, each on top of the ones before; nothing is compiled for it."""
    workshop.run(NAME_ONLY="1")
    kernels = workshop.kernels()
    assert len(kernels) == 1
    for what, (name, old, new) in CHANGES.items():
        workshop.edit(name, old, new)
        workshop.run(NAME_ONLY="1")
        assert len(workshop.kernels() - kernels) == 1, what
        kernels = workshop.kernels()
    workshop.run(NAME_ONLY="1")
    assert workshop.kernels() == kernels


@pytest.mark.soak
def test_processes_that_start_at_once_both_work_and_further_ones_load_what_they_compiled(workshop):
    processes = [workshop.start(), workshop.start()]
    one, two = [workshop.ended(process) for process in processes]
    assert one == two == pytest.approx(settled(BEFORE), rel=1e-3)
    files = workshop.files()
    assert len(workshop.kernels()) == 1
    assert any(path.suffix == ".nbc" for path in files)
    assert not list(workshop.cache.glob("*.tmp"))
    assert workshop.run() == one
    assert workshop.files() == files
    workshop.edit("shared.py", "2.0 * value", "4.0 * value")
    assert workshop.run() == pytest.approx(settled(BEFORE + 0.5), rel=1e-3), "a helper counts"


@pytest.mark.soak
def test_a_cache_folder_that_cannot_be_made_is_done_without(workshop):
    workshop.cache.write_text("a file stands where the folder should be")
    assert workshop.run() == pytest.approx(settled(BEFORE), rel=1e-3)


@pytest.mark.soak
def test_a_cache_folder_that_takes_no_machine_code_is_done_without(workshop):
    workshop.cache.mkdir(mode=0o700)
    (workshop.cache / "__pycache__").write_text("in the way")
    blocked = workshop.folder / "blocked"
    blocked.write_text("no home either")
    home = str(blocked / "home")
    found = workshop.run_alone(HOME=home, XDG_CACHE_HOME=home)
    assert found == pytest.approx(settled(BEFORE), rel=1e-3)


@pytest.mark.soak
@pytest.mark.skipif(os.name == "nt", reason="no limit of a file's size here")
def test_a_full_disk_is_done_without(workshop):
    # Files may grow to 20 kB: the kernel's text is stored, its machine code is not.
    (workshop.folder / "sitecustomize.py").write_text(
        "import resource, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
    )
    assert workshop.run_alone() == pytest.approx(settled(BEFORE), rel=1e-3)
    assert not any(path.suffix == ".nbc" for path in workshop.files())


# --- who may write to the cache ---------------------------------------------------------------

posix = pytest.mark.skipif(os.name == "nt", reason="Windows keeps no such bits of a folder")
CURE = "remove it, and it is made anew for you alone; or name another in RIG_CACHE_DIR"


@posix
def test_the_cache_folder_is_made_for_its_user_alone(workshop):
    workshop.run(NAME_ONLY="1")
    assert workshop.cache.stat().st_mode & 0o777 == 0o700
    workshop.cache.chmod(0o755)  # others may read it
    workshop.run(NAME_ONLY="1")


@posix
@pytest.mark.parametrize("mode", mostly_soak([0o702, 0o770, 0o1777]), ids=oct)
def test_a_chosen_folder_that_others_may_write_to_is_refused(workshop, mode):
    workshop.cache.mkdir()
    workshop.cache.chmod(mode)
    _, _, errors = workshop.tried(NAME_ONLY="1")
    told = (
        f"{workshop.cache}: others may write to it, and compiled kernels in it are run as they are"
    )
    assert errors.endswith(f"ModelError: RIG_CACHE_DIR: {told}; {CURE}\n")
    assert not workshop.files()


@posix
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives away")
def test_a_chosen_folder_of_another_user_is_refused(workshop):
    workshop.cache.mkdir(mode=0o700)
    os.chown(workshop.cache, 65534, 65534)
    _, _, errors = workshop.tried(NAME_ONLY="1")
    assert f"ModelError: RIG_CACHE_DIR: {workshop.cache}: it belongs to another user, and" in errors
    assert not workshop.files()


def test_a_kept_text_that_was_cut_is_written_anew(tmp_path, monkeypatch):
    folder = tmp_path / "kernels"
    monkeypatch.setenv("RIG_CACHE_DIR", str(folder))
    text = "def raised(x, y):\n    a = x + y\n    b = a * y\n    c = b - x\n    return c * c\n"
    (function,) = compiled_text("cut", text, ["raised"])
    assert function(1.0, 2.0) == 25.0
    (file,) = folder.glob("cut_*.py")
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:-9], b"", b"\xff\0"):
        file.write_bytes(content)
        (function,) = compiled_text("cut", text, ["raised"])
        assert function(1.0, 2.0) == 25.0
        assert file.read_bytes() == whole


def test_threads_that_ask_for_the_same_kernels_get_the_same():
    model = lag()
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: (kernels(model), tangents(model)), range(16)))
    assert all(one is made[0][0] and other is made[0][1] for one, other in made)
