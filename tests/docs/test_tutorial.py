"""The tutorial: its commands are run, in its order, on files as it writes them.

Identifications have few free parameters: all that are free by default take minutes. The first draws
its report, the others leave theirs out.
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


@pytest.mark.skipif(os.name == "nt", reason="its commands are written for a POSIX shell")
def test_every_command_works_as_it_stands(tmp_path):
    folder, commands, identified = tmp_path, 0, False
    for kind, text in BLOCK.findall(TUTORIAL.read_text(encoding="utf-8")):
        if kind == "yaml":
            (folder / text.splitlines()[0].removeprefix("# ")).write_text(text)
            continue
        for line in text.splitlines():
            if line.startswith("cd "):
                folder = folder / line.removeprefix("cd ")
                continue
            words = list(arguments(line, folder))
            identifies = bool({"identify", "--identify"} & set(words))
            if identifies:
                settings = folder / "identification.yaml"
                content = yaml.safe_load(settings.read_text()) | few_free()
                settings.write_text(yaml.safe_dump(content))
                words += [] if "--config" in words else ["--config", "identification.yaml"]
            result = rig(*words, cwd=folder, timeout=600, report=not identified)
            assert result.returncode == 0, f"{line}\n{result.stdout}\n{result.stderr}"
            assert "Traceback" not in result.stderr
            identified |= identifies
            commands += 1
    assert commands >= 8 and list(tmp_path.rglob("report.html"))
