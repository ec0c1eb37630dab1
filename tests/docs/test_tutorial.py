"""The tutorial: its commands are run, in its order, on files as it writes them.

Identifications have few free parameters, and logs half a second: all that are free by default take
minutes, and time goes with a log's length. The first draws its report, the others leave theirs out.
"""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import pytest
import yaml

from tests.daq.support import few_free, rig

pytestmark = pytest.mark.soak

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(sh|yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def arguments(line, folder):
    """What a shell gives to the command of a line."""
    words = shlex.split(line)
    assert words[0] == "rig"
    for word in words[1:]:
        paths = [str(path.relative_to(folder)) for path in sorted(folder.glob(word))]
        yield from paths or [word]


def shorten(experiment):
    """Half a second of excitation: enough for every command to have something to say."""
    content = yaml.safe_load(experiment.read_text(encoding="utf-8"))
    experiment.write_text(yaml.safe_dump(content | {"duration": 0.5}), encoding="utf-8")


@pytest.mark.skipif(os.name == "nt", reason="its commands are written for a POSIX shell")
def test_every_command_works_as_it_stands(tmp_path):
    folder, printed, identified = tmp_path, [], False
    for kind, text in BLOCK.findall(TUTORIAL.read_text(encoding="utf-8")):
        if kind == "yaml":
            (folder / text.splitlines()[0].removeprefix("# ")).write_text(text)
            continue
        for line in text.splitlines():
            if line.startswith("cd "):
                folder = folder / line.removeprefix("cd ")
                continue
            words = list(arguments(line, folder))
            if words[0] == "run":
                shorten(folder / words[1])
            identifies = bool({"identify", "--identify"} & set(words))
            if identifies:
                settings = folder / "identification.yaml"
                content = yaml.safe_load(settings.read_text("utf-8")) | few_free()
                settings.write_text(yaml.safe_dump(content))
                words += [] if "--config" in words else ["--config", "identification.yaml"]
            result = rig(*words, cwd=folder, timeout=600, report=not identified)
            assert result.returncode == 0, f"{line}\n{result.stdout}\n{result.stderr}"
            assert "Traceback" not in result.stderr
            identified |= identifies
            printed.append(result.stdout)
    assert len(printed) >= 8 and list(tmp_path.rglob("report.html"))
    # What it says of worn brushes.
    assert any("The model lacks a term in the sign of omega" in text for text in printed)
