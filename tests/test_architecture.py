"""What keeps the house in order: rooms, names and who prints, read from the source itself."""

import ast
import functools
import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("daq", "haptics", "sysid", "sim_rig", "protocols")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

# Said by grammar, not by what a thing is.
GRAMMAR = {"found", "told", "own", "one", "known", "asked", "said", "some", "other", "still"}
# Gerunds that are nouns of the field.
NOUNS = {
    "timing",
    "tuning",
    "torque_tracking",
    "scaling",
    "sampling",
    "damping",
    "fitting",
    "judging",
    "recording",
}


KEYS_OF_FILES = {("daq/config/rig.py", "own")}  # limits.own


@functools.cache
def trees():
    """Every module with its syntax tree."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def variables_of(tree):
    """Names that a module binds: variables, parameters, attributes of self, loop targets."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno


def test_a_variable_is_named_after_what_it_is():
    by_grammar = [
        f"{name_of(path)}:{line}: {name}"
        for path, tree in trees().items()
        for name, line in variables_of(tree)
        if name.strip("_") in GRAMMAR and (name_of(path), name) not in KEYS_OF_FILES
    ]
    assert not by_grammar


@pytest.mark.parametrize("package", PACKAGES)
def test_a_class_name_stands_once_in_a_package(package):
    places = defaultdict(list)
    for path, tree in trees().items():
        if path.is_relative_to(ROOT / package):
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name].append(f"{name_of(path)}:{node.lineno}")
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_a_module_is_a_noun():
    assert {path.stem for path in MODULES if re.search(r"[a-z]{2}ing$", path.stem)} <= NOUNS


def test_no_room_is_for_leftovers():
    rooms = {part for path in MODULES for part in path.relative_to(ROOT).with_suffix("").parts}
    assert not rooms & {"utils", "util", "common", "helpers", "misc", "tools"}


def test_rooms_and_floors_of_sysid():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    (layers,) = (
        contract["layers"]
        for contract in contracts["contracts"]
        if contract.get("containers") == ["sysid"]
    )
    rooms = [
        path for path in (ROOT / "sysid").iterdir() if path.stem not in {"__init__", "__pycache__"}
    ]
    assert len(layers) <= 8
    assert len(rooms) <= 15


def test_only_the_command_line_prints():
    """``print`` and the standard streams stand in ``daq/cli`` alone."""
    printing = []
    for path, tree in trees().items():
        if path.is_relative_to(ROOT / "daq" / "cli"):
            continue
        for node in ast.walk(tree):
            is_print = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
            if is_print and node.func.id == "print":
                printing.append(f"{name_of(path)}:{node.lineno}")
    assert not printing


def test_a_use_case_knows_nothing_of_json():
    """What becomes of a result is decided where it is shown."""
    knowing = [
        f"{name_of(path)}:{line}"
        for path, tree in trees().items()
        if not path.is_relative_to(ROOT / "daq" / "cli")
        for name, line in variables_of(tree)
        if name == "as_json"
    ]
    assert not knowing
