"""The gallery's systems are found from a small form of their own data."""

import re
import sys

import numpy as np
import pytest
import yaml

from sysid import GASSI
from tests.examples.conftest import EXAMPLES

GALLERY = EXAMPLES / "gallery"
SYSTEMS = (
    "two_tanks",
    "oscillator",
    "aeropendulum",
    "air_vessel",
    "heater",
    "battery",
    "elastic_shaft",
    "quarter_car",
    "reactor",
)


@pytest.fixture
def gallery(example, monkeypatch):
    monkeypatch.syspath_prepend(str(GALLERY))
    return example


def test_each_has_settings_and_a_place_in_the_table(gallery):
    assert gallery("make").SYSTEMS == SYSTEMS
    table = (GALLERY / "README.md").read_text(encoding="utf-8")
    for name in SYSTEMS:
        module = gallery(name)
        settings = yaml.safe_load((GALLERY / f"{name}.yaml").read_text(encoding="utf-8"))
        assert settings["model"] == f"{name}.py:model"
        assert set(settings["columns"]["outputs"]) == set(module.model.output_names)
        assert set(module.TRUTH) == set(module.model.parameter_names)
        assert table.count(f"`{name}`]({name}.py)") == 1 and f"`{name}.py`" in table
        lines = (GALLERY / f"{name}.py").read_text(encoding="utf-8").splitlines()
        assert len(lines) <= 60


@pytest.mark.parametrize("name", ["actuator", "dc_motor", "friction_drive", *SYSTEMS])
def test_each_has_a_result_in_the_table(name):
    table = (GALLERY / "README.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| \[`{name}`\]\(.+\) \| `\w+` \| .+ \.\. ", table, re.MULTILINE)


def test_help_makes_nothing(gallery, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make.py", "--help"])
    with pytest.raises(SystemExit) as end:
        gallery("make").main()
    assert end.value.code == 0 and "python make.py" in capsys.readouterr().out


@pytest.mark.soak
@pytest.mark.parametrize("name", SYSTEMS)
def test_it_is_found_from_a_short_record(gallery, name):
    make, module = gallery("make"), gallery(name)
    record = make.record(module, 800, seed=3)
    estimator = GASSI(make.from_rest(module.model), population=60, generations=10, accuracy=1e-4)
    found = estimator.fit([record]).parameters_
    errors = [abs(np.log(found[key] / value)) for key, value in module.TRUTH.items()]
    assert max(errors) < 0.1
