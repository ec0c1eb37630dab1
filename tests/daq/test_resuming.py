"""``rig identify --resume``: an identification that was stopped goes on as it was asked."""

import re
import shutil
import signal

import pytest
import yaml

from tests.daq.support import few_free, rig, start_rig, until, write_experiment, write_yaml

SIZE = ("--population", 80, "--generations", 120)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    root = tmp_path_factory.mktemp("resume")
    write_experiment(root / "e.yaml", validation={"motor": {"seed": 77}})
    result = rig("run", "e.yaml", cwd=root)
    assert result.returncode == 0, result.stderr
    (folder,) = (root / "runs").iterdir()
    return root, folder


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Options of an identification that takes no longer than it must."""
    # In a folder of its own, for files are named as seen from where a command was given.
    return "--config", write_yaml(tmp_path_factory.mktemp("settings") / "few.yaml", few_free())


def parameters(folder):
    report = yaml.safe_load((folder / "parameters.yaml").read_text("utf-8"))
    return {key: value for key, value in report.items() if key != "software"}


@pytest.mark.soak
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_a_killed_identification_goes_on_to_the_same_result(captured, few, tmp_path):
    root, folder = captured
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert rig("identify", folder, *few, *SIZE, "--out", whole, cwd=root).returncode == 0
    process = start_rig("identify", folder.relative_to(root), *few, *SIZE, "--out", cut, cwd=root)
    checkpoint = cut / "search.ckpt"
    until(checkpoint.exists, "a checkpoint")
    first = checkpoint.stat().st_mtime_ns
    until(lambda: checkpoint.stat().st_mtime_ns > first, "a later checkpoint")
    process.kill()
    process.communicate()
    assert not (cut / "parameters.yaml").exists()
    # From another working folder: what was asked is known.
    result = rig("identify", "--resume", cut, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert parameters(cut) == parameters(whole)
    assert [path.name for path in cut.iterdir()] == [path.name for path in whole.iterdir()]


@pytest.mark.soak
def test_ctrl_c_says_how_to_go_on(captured, few, tmp_path):
    root, folder = captured
    out = tmp_path / "out"
    process = start_rig("identify", folder, *few, *SIZE[:-1], 5000, "--out", out, cwd=root)
    until((out / "search.ckpt").exists, "a checkpoint")
    first = (out / "search.ckpt").stat().st_mtime_ns
    until(lambda: (out / "search.ckpt").stat().st_mtime_ns > first, "a later checkpoint")
    process.send_signal(signal.SIGINT)
    text, errors = process.communicate(timeout=120)
    assert process.returncode == 1, errors
    hint = re.search(r"rig identify --resume (\S+)", text.replace("\n", ""))
    assert hint is not None and hint[1] == str(out)
    assert (out / "search.ckpt").exists() and (out / "parameters.yaml").exists()


@pytest.mark.soak
def test_nothing_is_left_of_an_identification_that_ended(captured, few, tmp_path):
    root, folder = captured
    result = rig("identify", folder, *few, "--out", tmp_path / "o", cwd=root)
    assert result.returncode == 0, result.stderr
    assert [path.name for path in (tmp_path / "o").iterdir()] == ["parameters.yaml"]
    result = rig("identify", "--resume", tmp_path / "o", cwd=root)
    assert result.returncode == 2 and "no identification was interrupted there" in result.stderr


@pytest.mark.soak
def test_what_has_changed_meanwhile_is_named(captured, few, tmp_path):
    root, folder = captured
    log = tmp_path / "log.csv"
    shutil.copy(folder / "log.csv", log)
    process = start_rig("identify", log, *few, *SIZE, "--out", tmp_path / "o", cwd=root)
    until((tmp_path / "o" / "search.ckpt").exists, "a checkpoint")
    process.kill()
    process.communicate()
    lines = log.read_text("utf-8").splitlines(keepends=True)
    log.write_text("".join(lines[:-20]))
    result = rig("identify", "--resume", tmp_path / "o", cwd=root)
    assert result.returncode == 2
    assert "belongs to another identification" in result.stderr
    assert re.search(r"samples 400, here 380", " ".join(result.stderr.split()))


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["identify"], "name the logs"),
        (["identify", "log.csv", "--resume", "."], "leave out LOG"),
        (["identify", "--resume", ".", "--population", "9"], "leave out --population"),
        (["identify", "--resume", "nowhere"], "no identification was interrupted there"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, args, message):
    result = rig(*args, cwd=tmp_path)
    assert result.returncode == 2
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr
