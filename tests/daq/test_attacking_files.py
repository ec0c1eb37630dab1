"""Files made to exhaust the program that reads them: refused by place and cure, and at once."""

import json
import math
import re

import pytest
import yaml

from daq.scope.watch import FollowedLog
from tests.daq.support import rig
from tests.daq.test_log import original_text

KEYS = 20_000
NESTED = "[" * 100_000
DIGITS = "9" * 1_000_000
# Each line has the one before nine times over.
LAUGHS = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))
MERGES = "".join(f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * 9)}]}}\n" for k in range(1, 12))

# By name: a text that is no good as any file of settings, and how it is refused.
ATTACKS = {
    "nested lists": (f"a: {NESTED}", ":1:23: nested more than 20 levels deep; is a bracket before"),
    "nested mappings": ("{a: " * 100_000, ":1:81: nested more than 20 levels deep"),
    "nested indents": (
        "".join(f"{' ' * k}a:\n" for k in range(200)),
        ":21:21: nested more than 20 levels deep",
    ),
    "a long number": (f"protocol: prbs\na: {DIGITS}\n", ":2:4: a number of 1000000 characters"),
    "a long hexadecimal number": (f"a: 0x{DIGITS}\n", ":1:4: a number of 1000002 characters"),
    "a long number in base 60": ("a: 1" + ":59" * 100_000, ":1:4: a number of 300001 characters"),
    "a number by its tag": (f'a: !!int "{DIGITS}"', ":1:4: a number of 1000000 characters"),
    "aliases": (f"a0: &a0 [0]\n{LAUGHS}", ":6:40: aliases (*name) make more than 100000 keys"),
    "merges": (f"m0: &m0 {{x: 1}}\n{MERGES}", ":6:30: aliases (*name) make more than 100000 keys"),
    "an alias of itself": ("a: &a {b: [*a]}", ":1:12: alias *a stands inside its own anchor &a"),
    "a merge of itself": ("a: &a {<<: *a}", ":1:12: alias *a stands inside its own anchor &a"),
    "too many values": (f"a: [{'0,' * 300_000}]", ":1:199999: more than 100000 keys and values"),
    "too many bytes": (f"a: 1\n{'#' * 20_000_000}", ": larger than 20 MB; is it the right file?"),
    "bytes of zero": ("a: 1\nb: \0\n", ":2: not text: it holds a control character (byte 0)"),
    "no UTF-8": (b"a: 1\nb: \xe9\n", ":2: not text in UTF-8; save the file with this encoding"),
}
# Commands that read a file of settings, and the name of it.
READERS = {
    "e.yaml": ["check", "e.yaml"],
    "rig.yaml": ["run", "prbs.yaml", "--rig", "rig.yaml"],
    "id.yaml": ["identify", "log.csv", "--config", "id.yaml"],
    "sheet.yaml": ["identify", "log.csv", "--datasheet", "sheet.yaml"],
    "parameters.yaml": ["replay", "log.csv", "--parameters", "parameters.yaml"],
}


def refusal(args, folder):
    """What a command says that must refuse, shortly."""
    done = rig(*args, cwd=folder, timeout=60)
    print(done.stderr[:2000])
    assert done.returncode == 2
    assert all(line.startswith("rig: ") for line in done.stderr.splitlines())
    assert len(done.stderr) < 10_000
    return done.stderr


@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attacking_experiment_is_refused_by_its_place(attack, tmp_path):
    text, said = ATTACKS[attack]
    (tmp_path / "e.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert f"rig: e.yaml{said}" in refusal(["check", "e.yaml"], tmp_path)


@pytest.mark.parametrize("name", READERS)
def test_every_reader_of_settings_has_these_bounds(name, tmp_path):
    (tmp_path / "log.csv").write_text(original_text())
    for attack in ("nested lists", "a long number", "merges", "no UTF-8"):
        text, said = ATTACKS[attack]
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        assert f"rig: {name}{said}" in refusal(READERS[name], tmp_path)


@pytest.mark.parametrize("value", ["[" * 50_000, "9" * 50_000, f"&a [{'*a,' * 20_000}]"])
def test_a_typed_setting_has_these_bounds(value, tmp_path):
    (tmp_path / "log.csv").write_text(original_text())
    said = refusal(["identify", "log.csv", "--set", f"population={value}"], tmp_path)
    assert said.startswith(f"rig: --set population={value[:46]}...: ")


def test_a_setting_in_too_many_sections_is_refused(tmp_path):
    (tmp_path / "log.csv").write_text(original_text())
    setting = ".".join(["a"] * 5000) + "=1"
    assert "write KEY=VALUE" in refusal(["identify", "log.csv", "--set", setting], tmp_path)


JSON = {
    "nested": ("[" * 100_000, ":1: nested more than 20 levels deep"),
    "nested but balanced": (f"{NESTED}{']' * 100_000}", ":1: nested more than 20 levels deep"),
    "a long number": (f'{{\n"a": {DIGITS}}}', ":2: a number of 1000000 characters"),
    "too many values": (f'{{"a": [{"0," * 300_000}0]}}', ":1: more than 100000 keys and values"),
    "too many bytes": ('"' + "x" * 20_000_000, ": larger than 20 MB"),
    "bytes of zero": ('{"a":\n "\0"}', ":2: not text: it holds a control character (byte 0)"),
    "no UTF-8": (b'{"a":\n "\xe9"}', ":2: not text in UTF-8"),
    "a string without end": ('{"a": "' + '\\"' * 1_000_000, ":1:7: not a readable"),
    "a list": ("[]", ": not a "),
}


@pytest.mark.parametrize("attack", JSON)
def test_a_record_that_attacks_is_refused_by_its_line(attack, tmp_path):
    text, said = JSON[attack]
    data = text if isinstance(text, bytes) else text.encode()
    (tmp_path / "log.csv").write_text(original_text())
    for name in ("run.json", "report.json", "search.json"):
        (tmp_path / name).write_bytes(data)
    assert f"run.json{said}" in refusal(["identify", "."], tmp_path)
    assert f"report.json{said}" in refusal(["figures", "."], tmp_path)
    assert f"search.json{said}" in refusal(["identify", "--resume", "."], tmp_path)
    assert said in FollowedLog(tmp_path / "log.csv").state.problem


@pytest.mark.parametrize("name", ["e.yaml", "rig.yaml", "id.yaml"])
def test_of_many_unknown_keys_the_first_are_told_and_their_number(name, tmp_path):
    (tmp_path / "log.csv").write_text(original_text())
    kind = {"e.yaml": "protocol: prbs", "rig.yaml": "backend: simulated", "id.yaml": "seed: 1"}
    keys = "".join(f"zz{k}: 1\n" for k in range(KEYS))
    (tmp_path / name).write_text(f"{kind[name]}\n{keys}")
    said = refusal(READERS[name], tmp_path)
    assert f"rig: {name}:2:1: zz0: unknown key" in said
    assert re.search(rf"rig: {name}: and 199\d\d more mistakes$", said)


def test_of_many_repeated_keys_the_first_are_told_and_their_number(tmp_path):
    (tmp_path / "e.yaml").write_text("protocol: prbs\n" + "seed: 1\n" * KEYS)
    said = refusal(["check", "e.yaml"], tmp_path)
    assert "e.yaml:3:1: seed: this key stands twice, first in line 2; keep one" in said
    assert re.search(r"rig: e.yaml: and 199\d\d more mistakes$", said)


def test_a_long_list_of_numbers_is_taken(tmp_path):
    n, dt = 10_000, 1 / 800
    levels = [round(0.1 * math.sin(0.01 * k), 6) for k in range(n)]
    experiment = {
        "protocol": "steps",
        "sample_rate": 800,
        "motor": {"offset": 0.2, "levels": levels, "hold": dt},
        "brake": {"offset": 0.0},
    }
    (tmp_path / "e.yaml").write_text(yaml.safe_dump(experiment))
    done = rig("check", "e.yaml", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["samples"] == n
