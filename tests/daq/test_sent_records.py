"""A run or a result that somebody sent: what it names is not run here before somebody says so."""

import json
import os
import shutil
import signal

import pytest
import yaml

from daq import ConfigError, analyse, identify, replay, resume
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.pytest_plugin import Replayer, SimulatedRig
from tests.daq.support import (
    few_free,
    only_capture,
    record_of,
    rig,
    write_experiment,
    write_yaml,
)
from tests.daq.test_scope import request, start_scope

_MARK = """
from pathlib import Path
Path(__file__).with_name("ran").touch()
"""

# A waveform, and a model of the first order.
CODE = f"""{_MARK}
import numpy as np
from daq.experiment import Timed
from daq.findings import Findings
from sysid import Input, Output, Parameter, ProcessModel, State


class Rest(Timed):
    def waveform(self):
        return np.zeros((self.n_samples, 2))

    def findings(self, samples, extra):
        return Findings(remarks=(f"{{len(samples.time)}} samples of rest",))


model = ProcessModel(
    "lag",
    (State("current_motor", "A"),),
    (Input("applied_voltage_motor", "V"),),
    (Output("current_motor", "A"),),
    (Parameter("tau", "s", 0.01, 0.001, 1.0),),
    lambda x, u, p: ((u[0] - x[0]) / p[0],),
)
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("recorded")
    write_experiment(root / "e.yaml", duration=0.1)
    assert rig("run", "e.yaml", cwd=root).returncode == 0
    return only_capture(root)


@pytest.fixture
def sent(recorded, tmp_path):
    """A capture folder ``sent`` with a Python file beside its log."""
    folder = shutil.copytree(recorded, tmp_path / "sent")
    (folder / "theirs.py").write_text(CODE)
    return folder


def ran(folder):
    return (folder / "ran").exists()


def name_protocol(folder, name):
    record = record_of(folder)
    record["experiment"] = {"protocol": name, "duration": 0.1}
    (folder / "run.json").write_text(json.dumps(record))


def name_model(folder, name):
    content = {"model": name, "parameters": {"tau": 0.01}}
    path = folder / "parameters.yaml"
    path.write_text(yaml.safe_dump(content))
    (folder / "report.json").write_text("{}")
    return path


def name_experiments_model(folder, name):
    record = record_of(folder)
    record["experiment"]["model"] = name
    (folder / "run.json").write_text(json.dumps(record))


def request_search(folder, **asked):
    content = {"training": [str(folder / "log.csv")], "validation": [], "asked": asked}
    (folder / "search.json").write_text(json.dumps(content))


def refused(result, record, kind, file):
    """The command ended in one line that names the record, the file, and what to do."""
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr == (
        f"rig: {record}: {kind}: this record names {file.resolve()}, which would be run as a "
        "program; look at that file, then add --trust (in Python trust=True)\n"
    )
    assert not ran(file.resolve().parent)


# --- refused ------------------------------------------------------------------------------


def test_the_protocol_that_a_run_names(sent, tmp_path):
    name_protocol(sent, "theirs.py:Rest")
    refused(rig("analyse", "sent", cwd=tmp_path), "sent/run.json", "protocol", sent / "theirs.py")
    again = rig("analyse", "sent", "--trust", cwd=tmp_path)
    assert again.returncode == 0 and "80 samples of rest" in again.stdout, again.stderr
    assert ran(sent)


def test_a_file_elsewhere_on_this_machine_or_behind_a_link(sent, tmp_path):
    elsewhere = tmp_path / "home" / "theirs.py"
    elsewhere.parent.mkdir()
    elsewhere.write_text(CODE)
    (sent / "link.py").symlink_to(elsewhere)
    for name in (elsewhere, "link.py", "../home/theirs.py"):
        name_protocol(sent, f"{name}:Rest")
        refused(rig("analyse", "sent", cwd=tmp_path), "sent/run.json", "protocol", elsewhere)


@pytest.mark.parametrize("name", ["theirs.py", "theirs.py:model", "theirs.py:model:order=2"])
def test_the_model_that_a_result_names(sent, tmp_path, name):
    path = name_model(sent, name)
    command = ("replay", "sent", "--parameters", "sent/parameters.yaml")
    refused(rig(*command, cwd=tmp_path), "sent/parameters.yaml", "model", sent / "theirs.py")
    refused(
        rig("figures", "sent", cwd=tmp_path),
        path.relative_to(tmp_path),
        "model",
        sent / "theirs.py",
    )


def test_a_result_is_replayed_with_trust_and_says_how_to_go_on(sent, tmp_path):
    name_model(sent, "theirs.py:model")
    command = ("replay", "sent", "--parameters", "sent/parameters.yaml", "--trust")
    result = rig(*command, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    last = "Next: rig replay ANOTHER_LOG --parameters sent/parameters.yaml --trust"
    assert result.stdout.splitlines()[-1] == last


@pytest.mark.parametrize(
    "asked",
    [
        {"options": {"model": "{folder}/theirs.py:model"}},
        {"settings": ["model={folder}/theirs.py:model"]},
        {"config": "{folder}/id.yaml"},
        {"config": "{folder}/id.yaml", "options": {"model": None}},
    ],
    ids=["model", "setting", "settings' file", "no model"],
)
def test_the_model_of_a_search_that_was_interrupted(sent, tmp_path, asked):
    (sent / "id.yaml").write_text("model: theirs.py:model\n")
    request_search(sent, **json.loads(json.dumps(asked).replace("{folder}", str(sent))))
    result = rig("identify", "--resume", "sent", cwd=tmp_path)
    assert result.returncode == 2 and "--trust" in result.stderr and not ran(sent)
    assert "search.json: model: this record names" in result.stderr
    trusted = rig("identify", "--resume", "sent", "--trust", cwd=tmp_path)
    assert "there is no checkpoint to continue from" in trusted.stderr and ran(sent)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("theirs.py:model", "the experiment is for theirs.py:model, which would be run as a "),
        ("actuater", "unknown model 'actuater'; did you mean 'actuator'?"),
    ],
)
def test_the_model_that_a_runs_experiment_names(sent, tmp_path, name, problem):
    name_experiments_model(sent, name)
    result = rig("identify", "sent", cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith(f"rig: sent/run.json: model: {problem}")
    assert not ran(sent)


def test_a_run_is_identified_by_the_model_that_its_experiment_names(sent, recorded):
    name_experiments_model(sent, "actuator:friction=none")
    assert problem_of(SettingsRequest(), logs=[sent]).model_name == "actuator:friction=none"
    assert problem_of(SettingsRequest(), logs=[recorded]).model_name == "actuator"
    typed = SettingsRequest(None, {"model": "actuator"})
    assert problem_of(typed, logs=[sent]).model_name == "actuator"
    with pytest.raises(ConfigError, match="for different models: actuator:friction=none"):
        identify([sent, recorded])


def test_in_python(sent, tmp_path):
    name_protocol(sent, "theirs.py:Rest")
    path = name_model(sent, "theirs.py:model")
    request_search(sent, options={"model": f"{sent}/theirs.py:model"})
    for step in (
        lambda: analyse(sent),
        lambda: replay(sent, path),
        lambda: resume(sent),
        lambda: Replayer(tmp_path)("sent", "sent/parameters.yaml"),
    ):
        with pytest.raises(ConfigError, match="trust=True"):
            step()
        assert not ran(sent)
    assert analyse(sent, trust=True).findings.remarks == ("80 samples of rest",)
    assert Replayer(tmp_path)("sent", "sent/parameters.yaml", trust=True).model.name == "lag"


# --- not even looked at -------------------------------------------------------------------


@pytest.mark.soak
def test_commands_that_need_only_the_log_of_such_a_run(sent, tmp_path):
    name_protocol(sent, "theirs.py:Rest")
    write_yaml(tmp_path / "few.yaml", few_free())
    for command in (
        ("replay", "sent"),
        ("identify", "sent", "--config", "few.yaml", "--out", "found"),
    ):
        result = rig(*command, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
    process, address = start_scope("sent", cwd=tmp_path)
    assert request(address)[0] == 200
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert not ran(sent)


def test_what_is_installed_is_no_file(sent, tmp_path):
    (sent / "prbs.py").write_text(_MARK)
    result = rig("analyse", "sent", cwd=tmp_path)
    assert result.returncode == 2 and "concludes nothing by itself" in result.stderr
    assert not ran(sent)


# --- what the user names ------------------------------------------------------------------


def test_files_of_ones_own_need_no_trust_while_one_names_them(tmp_path):
    (tmp_path / "theirs.py").write_text(CODE)
    (tmp_path / "own.yaml").write_text("protocol: theirs.py:Rest\nduration: 0.1\n")
    result = rig("run", "own.yaml", cwd=tmp_path)
    assert result.returncode == 0 and "80 samples of rest" in result.stdout, result.stderr
    by_test = SimulatedRig(0, tmp_path, tmp_path / "tested").run("own.yaml")
    assert by_test.findings.remarks == ("80 samples of rest",)
    model, log = f"{tmp_path / 'theirs.py'}:model", by_test.folder
    assert identify(log, model=model, population=8, generations=1).model.name == "lag"


# --- compiled kernels ---------------------------------------------------------------------

posix = pytest.mark.skipif(os.name == "nt", reason="Windows keeps no such bits of a folder")


@posix
def test_a_chosen_cache_folder_that_others_may_write_to_is_refused(tmp_path):
    folder = tmp_path / "kernels"
    folder.mkdir()
    folder.chmod(0o777)
    result = rig("run", "prbs.yaml", cwd=tmp_path, env={"RIG_CACHE_DIR": str(folder)})
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr == (
        f"rig: RIG_CACHE_DIR: {folder}: others may write to it, and compiled kernels in it are run "
        "as they are; remove it, and it is made anew for you alone; or name another in "
        "RIG_CACHE_DIR\n"
    )
    assert not (tmp_path / "runs").exists()


@posix
@pytest.mark.soak
def test_the_usual_cache_folder_is_done_without_where_others_may_write_to_it(sent, tmp_path):
    name_model(sent, "theirs.py:model")
    folder = tmp_path / "home" / "hybrid-rig"
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    home = {name: str(folder.parent) for name in ("HOME", "XDG_CACHE_HOME")}
    command = ("replay", "sent", "--parameters", "sent/parameters.yaml", "--trust")
    env = {"RIG_CACHE_DIR": "", "PYTHONWARNINGS": "default::UserWarning", **home}
    result = rig(*command, cwd=tmp_path, env=env, fresh=True)
    assert result.returncode == 0, result.stderr
    (warning,) = [line for line in result.stderr.splitlines() if "kernels" in line]
    assert warning.startswith(f"rig: warning: {folder}: others may write to it, and compiled")
    assert not list(folder.iterdir())


def test_machine_code_that_somebody_sent_is_not_loaded(tmp_path):
    """Numba reads its settings in the working folder, also where to load machine code from."""
    write_experiment(tmp_path / "e.yaml")
    (tmp_path / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path}/elsewhere\n")
    result = rig("run", "e.yaml", cwd=tmp_path, fresh=True)
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "elsewhere").exists()
