"""What every command has in common at a terminal: how much it says, and what Tab offers."""

import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import typer

from daq.cli.app import app
from daq.cli.terminal import Volume, output, print_next, watching
from daq.progress import Note
from tests.daq.support import (
    RIG,
    environment,
    forked_rig,
    on_terminal,
    rig,
    write_experiment,
    write_rig,
)

GROUPS = typer.main.get_command(app).commands
COMMANDS = {
    " ".join((name, *more)): command
    for name, group in GROUPS.items()
    for more, command in (
        [((key,), each) for key, each in group.commands.items()]
        if hasattr(group, "commands")
        else [((), group)]
    )
}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_the_common_options_and_an_example(name):
    options = {option for parameter in COMMANDS[name].params for option in parameter.opts}
    assert {"--json", "--quiet", "-q", "--verbose", "-v"} <= options
    assert COMMANDS[name].help and COMMANDS[name].epilog.startswith("Example:")


@pytest.mark.skipif(sys.platform == "win32", reason="no such terminal")
@pytest.mark.parametrize("name", ["identify", "run", "emulate"])
def test_help_leaves_half_of_eighty_columns_to_its_texts(tmp_path, name):
    shown = on_terminal([name, "--help"], tmp_path, 80)
    options = shown.partition("\nOptions:\n")[2]
    behind = re.findall(r"^  -.*?  +(?=\S)", options, re.M)
    assert len(behind) > 5
    assert max(map(len, behind)) <= 36
    assert max(map(len, shown.splitlines())) <= 80
    words = " ".join(options.split())
    for parameter in COMMANDS[name].params[1:]:
        assert " ".join(parameter.help.split()) in words


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What a run says quietly, usually and verbosely, by option."""
    folder = tmp_path_factory.mktemp("volume")
    write_experiment(folder / "e.yaml")
    with forked_rig() as run:
        return {
            option: run(["run", "e.yaml", *filter(None, [option])], folder)
            for option in ("--quiet", "", "--verbose")
        }


def test_a_quiet_run_says_where_its_results_are_and_no_more(said):
    assert said["--quiet"].stderr == ""
    lines = said["--quiet"].stdout.splitlines()
    assert len(lines) == 1 and lines[0].startswith("Log: runs")


def test_usually_progress_and_the_next_command_are_told(said):
    assert "Exciting and logging: 400/400 samples" in said[""].stderr
    assert "\nNext: rig identify runs" in said[""].stdout


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1", "utf-8"])
def test_signs_that_an_encoding_lacks_end_no_command(tmp_path, encoding):
    """Piped on Windows they are UTF-8, whatever is asked for."""
    encoding = "utf-8" if sys.platform == "win32" else encoding
    result = subprocess.run(
        [*RIG, "models"], cwd=tmp_path, env=environment(PYTHONIOENCODING=encoding),
        capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    rule = "─" if encoding == "utf-8" else "?"
    assert result.returncode == 0 and result.stderr == b""
    assert f"\n {9 * rule}" in result.stdout.decode(encoding)


def test_a_verbose_run_says_which_files_and_plugins_it_uses(said):
    assert "e.yaml: protocol prbs is protocols.prbs.Prbs" in said["--verbose"].stderr
    assert "simulated.yaml: the shipped " in said["--verbose"].stderr
    assert said["--verbose"].stdout.splitlines()[1:] != []


def test_quiet_and_verbose_are_not_given_together(tmp_path):
    result = rig("check", "prbs.yaml", "-q", "-v", cwd=tmp_path)
    assert result.returncode == 2 and "not both" in result.stderr


TAB = [
    ("rig run ", {"prbs.yaml", "mine.yaml", "folder/"}, {"bench.yaml", "notes.yaml"}),
    ("rig run m", {"mine.yaml"}, {"prbs.yaml"}),
    ("rig run folder/", {"folder/inner.yaml"}, {"prbs.yaml"}),
    (
        "rig check mine.yaml --rig ",
        {"simulated.yaml", "bench.yaml", "worn.yaml", "folder/"},
        {"mine.yaml"},
    ),
    ("rig identify log.csv --preset ", {"default", "thesis", "cega", "classic"}, set()),
    ("rig identify log.csv --model ", {"actuator", "lag.py", "folder/"}, {"mine.yaml"}),
    ("rig models a", {"actuator"}, {"lag.py"}),
    ("rig init --protocol ", {"prbs"}, {"simulated"}),
    ("rig init --rig ", {"simulated", "serial"}, {"prbs"}),
    ("rig sch", {"schema"}, {"init"}),
    ("rig run nowhere/", set(), {"prbs.yaml"}),
]


@pytest.mark.parametrize(("typed", "offered", "not_offered"), TAB, ids=[t[0] for t in TAB])
def test_tab_offers_what_can_stand_there(tmp_path, typed, offered, not_offered):
    (tmp_path / "folder").mkdir()
    write_experiment(tmp_path / "mine.yaml")
    write_experiment(tmp_path / "folder" / "inner.yaml")
    write_rig(tmp_path / "bench.yaml")
    (tmp_path / "worn.yaml").write_text("options: {ideal: true}\n")
    (tmp_path / "notes.yaml").write_text("a: 1\n")
    (tmp_path / "lag.py").write_text("")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe")
    words = typed.split(" ")
    env = {"_RIG_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": f"{len(words) - 1}"}
    result = rig(cwd=tmp_path, env=env)
    found = set(result.stdout.split())
    assert offered <= found and not found & not_offered
    assert result.stderr == ""


def test_tab_completes_the_installed_command(tmp_path):
    """A shell asks that one, and not ``python -m``."""
    script = Path(sysconfig.get_path("scripts")) / "rig"
    env = environment(_RIG_COMPLETE="complete_bash", COMP_WORDS="rig sch", COMP_CWORD="1")
    result = subprocess.run(
        [script], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert (result.stdout.split(), result.stderr) == (["schema"], "")


TABLE = """
from daq.cli.terminal import print_steps, print_table, print_text
print_table("Title [rad/s]", ["name", "omega [rad/s]", "meaning"],
            [["K_m", "0.135 .. 0.151", "[low, high] of a :smile:" * 9]], text=["meaning"])
print_table("Wide", ["output", "RMSE, training", "with applied_voltage_motor", "fit [%]"],
            [["current_motor", "0.00969", "100 %", "98.7"]])
print_table("Named", ["output", "log", "RMSE", "in its unit"],
            [["omega", "20260101T120000Z-prbs-validation", "0.0256", "0.377 rad/s"]], text=["log"])
print_steps([("rig check RIG.yaml", "what the sensors read"), ("go", "on " * 21 + "and on")])
print_text("  " + "Trust: good. " * 9)
"""


def test_a_table_in_a_pipe_has_a_line_for_each_row_and_takes_nothing_for_markup(tmp_path):
    said = subprocess.run(
        [sys.executable, "-c", TABLE], env=environment(), capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert said[0] == "Title [rad/s]"
    (row,) = [line for line in said if "K_m" in line]
    assert "0.135 .. 0.151" in row and "[low, high] of a :smile:" * 9 in row
    assert any("omega [rad/s]" in line for line in said)
    assert said[-1].count("Trust: good.") == 9


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal is needed")
@pytest.mark.parametrize("columns", [30, 50, 60])
def test_a_narrow_terminal_cuts_nothing(columns):
    import pty

    main, other = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", TABLE],
        env=environment(COLUMNS=str(columns), TERM="xterm"),
        stdout=other,
    ) as running:
        assert running.wait(60) == 0
    os.close(other)
    shown = re.sub(r"\x1b\[[\d;]*m", "", os.read(main, 100_000).decode())
    os.close(main)
    assert "…" not in shown
    assert "0.135 .. 0.151" in shown and "omega [rad/s]" in shown
    assert shown.count(":smile:") >= 9
    # Heads are folded, where they have parts, and names only where that does not make room enough.
    assert re.search("current_ +0.00969 " if columns == 30 else "current_motor +0.00969 ", shown)
    assert "with applied_voltage_motor" not in shown and "voltage_" in shown
    assert ("applied_voltage_motor" in shown) == (columns == 60)
    steps = shown[shown.index("1. rig check") :].splitlines()
    assert steps[0] == "1. rig check RIG.yaml" and steps[1] == "   what the sensors read"
    assert max(map(len, steps)) <= columns
    sentences = [line for line in shown.splitlines() if "good." in line]
    assert len(sentences) > 1 and all(line.startswith("  ") for line in sentences)
    assert max(map(len, sentences)) <= columns
    if columns < 60:
        assert re.search("20260101T120000Z- +0.0256 ", shown), "wrapped where a name has a joint"
    wide = shown[shown.index("Wide") :].splitlines()
    assert columns == 30 or max(map(len, wide)) <= columns


BARS = """
import time
from daq.cli.terminal import watching
from daq.progress import Progress
with watching(quiet=False) as watch:
    watch(Progress("Search", 6, 40, "generation 6/40"))
    watch(Progress("Fit", 1, 9, "iteration 1"))
    time.sleep(1.2)
    watch(Progress("Fit", 9, 9, "iteration 9"))
    watch(Progress("Search", 2, 40, "generation 2/40"))
    time.sleep(0.3)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
def test_what_ended_early_is_full_when_the_next_begins_and_its_clock_stands(tmp_path):
    shown = on_terminal(["-c", BARS], tmp_path, columns=100, program=[sys.executable])
    frames = [frame.splitlines() for frame in shown.split("\r") if "Fit" in frame]
    full = 30 * "━"
    search, fit = frames[-1]
    assert full in search and "generation 2/40" in search
    assert full in fit and "iteration 9" in fit and float(re.search(r"(\d+\.\d) s", fit)[1]) >= 1.2
    meanwhile = next(search for search, fit in frames if "iteration 1" in fit)
    assert full in meanwhile and "generation 6/40" in meanwhile


FULL = """
from daq.cli.terminal import print_table
print_table("Parameters", ["parameter", "value", "95 % interval", "unit", "searched in"],
            [["mass", "0.119996", "0.119985 .. 0.120007", "kg", "0.01 .. 1"],
             ["damping", "1.40003", "1.39991 .. 1.40014", "N*s/m", "0.1 .. 10"],
             ["cube_of_position_in_velocity", "-154.34", "-154.39 .. -154.28", "m/s^2",
              "-1000 .. 1000"]], text=["unit"])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pty")
@pytest.mark.parametrize("columns", range(74, 95, 5))
def test_a_table_that_fills_a_terminal_is_no_wider_and_breaks_no_unit(tmp_path, columns):
    shown = on_terminal(["-c", FULL], tmp_path, columns=columns, program=[sys.executable])
    lines = [line.rstrip() for line in shown.splitlines()]
    assert max(map(len, lines)) <= columns
    assert not any(line == "─" for line in lines)
    for cell in ("0.119985 .. 0.120007", "-1000 .. 1000", "N*s/m", "m/s^2"):
        assert any(cell in line for line in lines)


def test_a_note_is_shown_once_however_often_it_is_given(capsys):
    with watching(quiet=True) as watch:
        for text in ("no cable", "no cable", "no hand", "no cable"):
            watch(Note("note", text))
    assert capsys.readouterr().err.splitlines() == ["rig: note: no cable", "rig: note: no hand"]


def test_what_a_next_command_is_for_is_said_with_it_or_not_at_all(capsys):
    for level in (Volume.QUIET, Volume.NORMAL):
        with output(level, documents_alone=False):
            print_next("rig identify LOG", purpose="Search longer:")
    assert capsys.readouterr().out == "Search longer:\nNext: rig identify LOG\n"


def test_the_package_starts_as_the_command_does():
    said = [
        subprocess.run(
            [sys.executable, "-m", module, "--version"],
            env=environment(), capture_output=True, text=True, check=True,
        ).stdout
        for module in ("daq", "daq.cli")
    ]  # fmt: skip
    assert said[0] == said[1] != ""


def test_the_combination_of_options_that_is_shown_is_one(tmp_path):
    shown = rig("models", "actuator", cwd=tmp_path).stdout
    name = re.search(r"Another combination: rig models (\S+), with", shown)[1]
    assert rig("models", name, cwd=tmp_path).returncode == 0
