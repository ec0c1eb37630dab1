"""The tutorial: its commands are run, in its order, on files as it writes them.

Identifications have few free parameters: all that are free by default take minutes. The first draws
its report, the others leave theirs out.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.daq.support import environment, few_free

pytestmark = pytest.mark.soak

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(sh|yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.skipif(os.name == "nt", reason="its commands are written for a POSIX shell")
def test_every_command_works_as_it_stands(tmp_path):
    folder, commands, identified = tmp_path, 0, False
    env = environment(PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    for kind, text in BLOCK.findall(TUTORIAL.read_text(encoding="utf-8")):
        if kind == "yaml":
            (folder / text.splitlines()[0].removeprefix("# ")).write_text(text)
            continue
        for line in text.splitlines():
            if line.startswith("cd "):
                folder = folder / line.removeprefix("cd ")
                continue
            words = shlex.split(line)
            assert words[0] == "rig"
            short = ""
            if {"identify", "--identify"} & set(words):
                settings = folder / "identification.yaml"
                content = yaml.safe_load(settings.read_text()) | few_free()
                settings.write_text(yaml.safe_dump(content))
                short = "" if "--config" in words else " --config identification.yaml"
                short += " --no-report" if identified else ""
                identified = True
            result = subprocess.run(
                line + short, shell=True, cwd=folder, env=env, capture_output=True, text=True,
                timeout=600, check=False,
            )  # fmt: skip
            assert result.returncode == 0, f"{line}\n{result.stdout}\n{result.stderr}"
            assert "Traceback" not in result.stderr
            commands += 1
    assert commands >= 8 and list(tmp_path.rglob("report.html"))
