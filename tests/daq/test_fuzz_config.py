"""Anything at all in a file's place: it is taken, or refused by line, column and key."""

import copy
import re

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daq.errors import ConfigError
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.lookup.experiments import load_experiment
from daq.lookup.rigs import load_rig
from daq.lookup.shipped import shipped_files
from tests.soak import mostly_soak

WORDS = st.sampled_from(
    [
        "5 V",
        "5 parrots",
        "0,1",
        "1e3",
        "yes",
        "first",
        "seed",
        "motor",
        "-",
        "[low",
        "m.py:X",
        "5 %",
    ]
)
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 3), st.floats(), st.text(max_size=4), WORDS
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.one_of(WORDS, st.integers(-1, 2)), inner, max_size=3)
    ),
    max_leaves=5,
)
SETTINGS = {
    "model": "actuator",
    "ranges": {"K_m": [0.1, 0.2]},
    "fixed": {"R_m": 1.18},
    "initial": {"omega": "first"},
    "hold": {"torque": "foh"},
    "columns": {
        "time": {"column": "t", "unit": "ms"},
        "inputs": {"torque": {"column": "T", "sign": -1}},
        "outputs": {"omega": {"constant": 1.0}},
    },
}


def content_of(path):
    return yaml.safe_load(path.read_text("utf-8"))


FILES = [
    *(
        (path.name, content_of(path), load_experiment)
        for path in shipped_files("protocol").values()
    ),
    *((path.name, content_of(path), load_rig) for path in shipped_files("backend").values()),
    ("identification.yaml", SETTINGS, lambda path: problem_of(SettingsRequest(str(path)))),
]


def keys_of(content, at=()):
    yield at
    if isinstance(content, dict | list):
        for key, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield from keys_of(value, (*at, key))


def changed(content, key, value, new_name):
    """The content with another value at a key, or under a new name beside it."""
    if not key:
        return value
    result = copy.deepcopy(content)
    section = result
    for part in key[:-1]:
        section = section[part]
    if new_name is not None and isinstance(section, dict):
        section[new_name] = section.pop(key[-1])
    else:
        section[key[-1]] = value
    return result


# One file of every kind first.
FILES.sort(key=lambda file: file[0] not in {"prbs.yaml", "serial.yaml", "identification.yaml"})


@pytest.mark.parametrize(
    ("name", "content", "load"), mostly_soak(FILES, 3), ids=[name for name, *_ in FILES]
)
@settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_anything_is_taken_or_refused_by_its_place(tmp_path, name, content, load, data):
    key = data.draw(st.sampled_from(list(keys_of(content))))
    new_name = data.draw(st.none() | WORDS)
    wrong = changed(content, key, data.draw(ANYTHING), new_name)
    path = tmp_path / name
    path.write_text(yaml.safe_dump(wrong, sort_keys=False, allow_unicode=True), encoding="utf-8")
    try:
        load(path)
    except ConfigError as error:
        for line in str(error).splitlines():
            assert re.match(rf"{re.escape(str(path))}(:\d+(:\d+)?)?: \S", line), line
            assert "Input should" not in line
