"""What ``rig check`` states and draws, against what NumPy and SciPy say of the commands."""

import json
import os
import shlex
import subprocess
import sys

import numpy as np
import pytest
import yaml
from scipy.signal import periodogram

from daq.config.rig import RigConfig
from daq.lookup.experiments import load_experiment
from daq.recording.preview import spectral_lines
from tests.daq.support import RIG, environment, forked_rig, write_experiment, write_rig
from tests.soak import mostly_soak

LOOP = '''
import numpy as np
from daq.experiment import Answer, ClosedLoop, Plan


class Loop(ClosedLoop):
    """Follows a speed."""

    columns = {"omega_ref": "rad/s"}
    known: bool = True

    def plan(self):
        reference = {"omega_ref": 3.0 * np.sin(0.1 * np.arange(80))} if self.known else {}
        return Plan(80, np.array([-2.0, 0.0]), np.array([2.0, 0.1]), references=reference,
                    remarks=("follows a sine",))

    def controller(self):
        return self

    def answer(self, sample):
        return Answer(0.0, 0.0, (0.0,))
'''


@pytest.fixture(scope="module")
def command():
    with forked_rig() as run:
        yield run


@pytest.fixture
def loop(tmp_path):
    (tmp_path / "loop.py").write_text(LOOP)

    def write(**changes):
        content = {"protocol": "loop.py:Loop"} | changes
        (tmp_path / "loop.yaml").write_text(yaml.safe_dump(content))
        return tmp_path

    return write


def test_the_stated_numbers_are_those_of_the_commands(command, tmp_path):
    write_experiment(tmp_path / "e.yaml", duration=2, brake={"amplitude": 0.0})
    stated = json.loads(command(["check", "e.yaml", "--json"], tmp_path).stdout)
    assert stated["samples"] == 1600 and stated["duration_seconds"] == 2.0
    assert stated["resolution_hz"] == 0.5
    motor = stated["channels"]["motor"]
    column = load_experiment(str(tmp_path / "e.yaml")).plan(RigConfig()).commands[:, 0]
    assert motor["lowest_volts"] == column.min() and motor["highest_volts"] == column.max()
    assert motor["mean_volts"] == pytest.approx(column.mean())
    assert motor["rms_volts"] == pytest.approx(np.sqrt(np.mean((column - column.mean()) ** 2)))
    peak = np.max(np.abs(column - column.mean()))
    assert motor["crest_factor"] == pytest.approx(peak / motor["rms_volts"])
    frequency, density = periodogram(column, 800.0)
    low, high = motor["power_band_hz"]
    total = density.sum()
    assert 0.9 <= density[(frequency >= low) & (frequency <= high)].sum() / total < 0.95
    assert density[frequency < low].sum() / total < 0.05
    assert density[frequency > high].sum() / total <= 0.05
    brake = stated["channels"]["brake"]
    assert brake["rms_volts"] == 0.0 and brake["changes"] == 0
    assert brake["crest_factor"] is None and brake["power_band_hz"] is None


def test_a_multisine_is_stated_without_its_ramps(command, tmp_path):
    stated = json.loads(command(["check", "multisine.yaml", "--json"], tmp_path).stdout)
    motor = stated["channels"]["motor"]
    assert stated["resolution_hz"] == 0.5
    assert f"crest factor {motor['crest_factor']:.3f}" in stated["remarks"][1]
    assert motor["power_band_hz"][0] >= 1.0 and motor["power_band_hz"][1] <= 99.0


def test_what_rounding_leaves_of_zero_is_zero(command, tmp_path):
    brake = {"amplitude": 0.1, "offset": 0.1, "band": [1, 20], "harmonics": "odd", "seed": 8}
    motor = {"amplitude": 1.5, "band": [1, 100], "seed": 1}
    e = {"protocol": "multisine", "sample_rate": 800, "period": 1, "periods": 2, "ramp": 0.1}
    more = {"draws": 2, "homing": {"turns": 5}, "motor": motor, "brake": brake}
    (tmp_path / "e.yaml").write_text(yaml.safe_dump({**e, **more}))
    lowest = load_experiment(str(tmp_path / "e.yaml")).plan(RigConfig()).commands[:, 1].min()
    assert 0.0 < lowest < 1e-15
    shown = command(["check", "e.yaml"], tmp_path).stdout
    assert next(line.split()[-1] for line in shown.splitlines() if line[:7] == " lowest") == "0"
    stated = json.loads(command(["check", "e.yaml", "--json"], tmp_path).stdout)
    assert stated["channels"]["brake"]["lowest_volts"] == 0.0


def test_machines_hear_of_limits_that_protect_nothing(command, tmp_path):
    for speed, count in ((190.0, 0), (191.0, 1)):
        limits, amplifiers = {"speed": speed}, {"motor": 0.5, "speed": 95.0}
        write_rig(tmp_path / "rig.yaml", amplifiers=amplifiers, limits=limits)
        result = command(["check", "still.yaml", "--rig", "rig.yaml", "--json"], tmp_path)
        warnings = json.loads(result.stdout)["warnings"]
        assert len(warnings) == count and all("limits.speed: 191" in text for text in warnings)


def test_the_next_command_can_be_typed_as_it_stands(command, tmp_path):
    write_experiment(tmp_path / "my first.yaml", validation={"motor": {"seed": 9}})
    result = command(["check", "my first.yaml"], tmp_path)
    (line,) = [line for line in result.stdout.splitlines() if line.startswith("Next: ")]
    assert shlex.split(line)[1:] == ["rig", "run", "my first.yaml", "--identify"]


@pytest.mark.parametrize("n", [400, 401])
def test_spectral_lines_are_the_amplitudes_of_cosines(n):
    time = np.arange(n) / 400
    column = 0.3 + 0.5 * np.cos(2 * np.pi * 40 / n * 400 * time + 1.0)
    column += 0.2 * np.cos(2 * np.pi * 7 / n * 400 * time)
    frequency, sizes = spectral_lines(column, 400.0)
    expected = np.zeros(n // 2)
    expected[[39, 6]] = 0.5, 0.2
    np.testing.assert_allclose(sizes, expected, atol=1e-12)
    np.testing.assert_allclose(frequency, np.arange(1, n // 2 + 1) * 400 / n)
    assert not spectral_lines(np.full(n, 0.1), 400.0)[1].any()


def test_the_highest_line_of_an_even_length_is_not_doubled():
    _, sizes = spectral_lines(np.tile([1.0, -1.0], 50), 400.0)
    assert sizes[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", mostly_soak(["png", "pdf", "svg"]))
def test_the_plot_is_written_where_it_was_asked_for_and_nothing_else_is(command, tmp_path, kind):
    result = command(["check", "steps.yaml", "--plot", f"check.{kind}"], tmp_path)
    assert result.returncode == 0, result.stderr
    assert f"Figure: check.{kind}" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == [f"check.{kind}"]
    start = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[kind]
    content = (tmp_path / f"check.{kind}").read_bytes()
    assert content.startswith(start) and len(content) > 5000


def test_a_closed_loop_states_its_range_and_draws_its_references(command, loop):
    folder = loop()
    result = command(["check", "loop.yaml", "--plot", "loop.png"], folder)
    assert result.returncode == 0, result.stderr
    assert "up to 80 samples at 800 Hz, up to 0.1 s" in result.stdout
    assert "omega_ref" in result.stdout and "rad/s" in result.stdout
    assert "follows a sine" in result.stdout and "crest" not in result.stdout
    assert (folder / "loop.png").stat().st_size > 5000
    stated = json.loads(command(["check", "loop.yaml", "--json"], folder).stdout)
    assert stated["channels"]["motor"]["highest_volts"] == 2.0
    assert stated["references"]["omega_ref"] == pytest.approx([-3.0, 3.0], rel=1e-2)


REFUSED_PLOTS = [
    ("absent/c.png", True, "absent/c.png: cannot be written: there is no folder absent, make"),
    ("c.png", False, "--plot c.png: loop.py:Loop says nothing beforehand"),
    ("c.jpg", True, "c.jpg: figures are written as"),
    ("loop.yaml/c.png", True, "there is no folder loop.yaml, make it first; or choose another"),
]


@pytest.mark.parametrize(("plot", "known", "message"), mostly_soak(REFUSED_PLOTS, always=2))
def test_a_plot_that_cannot_be_is_refused(command, loop, plot, known, message):
    folder = loop(known=known)
    (folder / "__pycache__").mkdir()  # Python's, for loop.py
    before = sorted(folder.iterdir())
    result = command(["check", "loop.yaml", "--plot", plot], folder)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    said = result.stderr.replace(os.sep, "/")
    for where in (folder, folder.resolve()):
        said = said.replace(f"{where.as_posix()}/", "")
    assert message in said
    assert sorted(folder.iterdir()) == before


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
@pytest.mark.parametrize("encoding", mostly_soak(["cp1252", "utf-8"]))
def test_a_terminal_of_80_columns_shows_everything_and_a_sketch(tmp_path, encoding):
    import pty

    master, slave = pty.openpty()
    process = subprocess.Popen(
        [*RIG, "check", "multisine.yaml"], cwd=tmp_path, stdout=slave, stderr=slave,
        env=environment(COLUMNS="80", PYTHONIOENCODING=encoding),
    )  # fmt: skip
    os.close(slave)
    shown = b""
    try:
        while part := os.read(master, 65536):
            shown += part
    except OSError:
        pass  # the terminal's other end is closed
    finally:
        os.close(master)
    assert process.wait(30) == 0
    text = shown.decode(encoding)
    assert "…" not in text and "crest factor" in text
    assert ("█" in text) == (encoding == "utf-8")


# --- which rig --------------------------------------------------------------------------------


def rig_of(command, folder, *options):
    result = command(["check", *options, "--json"], folder)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)["rig"]


def test_an_experiment_may_name_its_rig_and_the_command_another(command, tmp_path):
    assert rig_of(command, tmp_path, "constant_velocity.yaml") == "simulated rig, free shaft"
    named = ("constant_velocity.yaml", "--rig", "simulated.yaml")
    assert rig_of(command, tmp_path, *named) == "simulated rig"
    write_experiment(tmp_path / "e.yaml")
    assert rig_of(command, tmp_path, "e.yaml") == "simulated rig"
    # One beside the experiment is meant, from whatever folder.
    lab = tmp_path / "lab"
    lab.mkdir()
    write_experiment(lab / "e.yaml", rig="ours.yaml")
    (lab / "ours.yaml").write_text("name: ours\n")
    assert rig_of(command, tmp_path, "lab/e.yaml") == "ours"


@pytest.mark.parametrize(
    ("name", "message"), [("absent.yaml", "absent.yaml: there is no such file"), (7, "e.yaml:")]
)
def test_a_rig_that_is_not_there_is_told(command, tmp_path, name, message):
    write_experiment(tmp_path / "e.yaml", rig=name)
    result = command(["check", "e.yaml"], tmp_path)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
