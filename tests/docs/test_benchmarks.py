"""Commands of benchmarks, as documents and their own docstrings give them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"python -m benchmarks\.(\w+)([^`)]*)")
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.py")]
COMMANDS = [c for page in PAGES for c in COMMAND.findall(page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("module", sorted({module for module, _ in COMMANDS}))
def test_a_benchmark_has_the_options_that_it_is_said_to_have(module):
    sources = [ROOT / "benchmarks" / f"{name}.py" for name in (module, "_common", "_peers")]
    code = "".join(source.read_text(encoding="utf-8") for source in sources)
    told = {o for m, words in COMMANDS if m == module for o in re.findall(r"--[a-z-]+", words)}
    assert sorted(option for option in told if f'"{option}"' not in code) == []
