"""``rig models NAME --identifiable``: what no log can tell, for people and as JSON."""

import json

import pytest

from tests.daq.support import rig
from tests.soak import mostly_soak

MODELS = """
from sysid import Input, Output, Parameter, ProcessModel, State

TABLE = [1.0, 2.0]


def motor(x, u, p):
    R, K, J, B = p
    return ((K * (u[0] - K * x[0]) / R - B * x[0]) / J,)


def looked_up(x, u, p):
    return (TABLE[int(x[0])] - p[1] * x[0],)


def made(derivative):
    units = {"R": "ohm", "K": "N*m/A", "J": "kg*m^2", "B": "N*m*s/rad"}
    return ProcessModel(
        "motor",
        [State("omega", "rad/s")],
        [Input("voltage", "V")],
        [Output("omega", "rad/s")],
        [Parameter(name, unit, 0.5, 0.1, 2.0, "log") for name, unit in units.items()],
        derivative,
    )


model, table = made(motor), made(looked_up)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("models")
    (path / "motor.py").write_text(MODELS)
    (path / "id.yaml").write_text("model: motor.py:model\nfixed: {R: 1300 mohm}\n")
    return path


def test_people_read_what_acts_together_and_what_to_do(folder):
    result = rig("models", "motor.py", "--identifiable", "--config", "id.yaml", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "Fixed: R 1.3." in result.stdout
    assert "K, J, B act only together. Outputs determine\n" in result.stdout
    assert "    K / J        1/(A*s^2)\n    K + R B / K  N*m/A\n" in result.stdout
    assert "measure K by other means and give it under 'fixed'." in result.stdout


@pytest.mark.parametrize("arguments", mostly_soak([[], ["--identifiable"]]))
def test_values_that_rest_on_assumed_ends_are_told_with_them(tmp_path, arguments):
    result = rig("models", "actuator:limits=true", *arguments, cwd=tmp_path)
    assert result.stdout.startswith("actuator:limits=true: ")
    assert "24 V and 2.5 A, are assumed" in " ".join(result.stdout.split())
    assert ("sat(v_b, 24)" in result.stdout) == (not arguments)
    assert "assumed" not in rig("models", "actuator", *arguments, cwd=tmp_path).stdout


def test_machines_read_the_same(folder):
    result = rig("models", "--identifiable", "--config", "id.yaml", "--json", cwd=folder)
    document = json.loads(result.stdout)
    (group,) = document["tied"]
    assert document["identifiable"] == [] and document["fixed"] == {"R": 1.3}
    assert group["combinations"] == [
        {"text": "K / J", "unit": "1/(A*s^2)"},
        {"text": "K + R B / K", "unit": "N*m/A"},
    ]
    assert group["fix"] == ["K"] and group["sensors"] == {}
    # Along the direction K / J stays, and so does K + R B / K.
    at, (direction,) = group["at"], group["directions"]
    step = dict(zip(group["parameters"], direction, strict=True))
    K, B = at["K"], at["B"]
    assert step["K"] / K == pytest.approx(step["J"] / at["J"])
    assert step["K"] * (1.0 - 1.3 * B / K**2) == pytest.approx(-1.3 * step["B"] / K)


def test_other_outputs_are_asked_about_with_set(tmp_path):
    given = ("--set", "fixed.R_b=126", "--set", "tied.J_b=J_m/2", "--set", "initial.z=0")
    result = rig("models", "actuator", "--identifiable", *given, cwd=tmp_path)
    assert "Fixed: R_b 126, K_v2i 0.5, n_c -1, J_b = J_m/2." in result.stdout
    assert "Unknown at the start" not in result.stdout
    alone = result.stdout.split("Identifiable by themselves: ")[1].split(".\n")[0].split(", ")
    assert {"L_b", "K_db", "J_m"} <= set(alone)
    assert "B_m, c0 act only together" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["motor.py:table", "--identifiable"], "int() argument"),
        (["--identifiable"], "rig models NAME --identifiable"),
        (["actuator", "--set", "fixed.R_b=1"], "go with --identifiable"),
        (["actuator", "--identifiable", "--set", "fixed.R_x=1"], "R_x"),
    ],
)
def test_mistakes_are_answered_in_words(folder, arguments, said):
    result = rig("models", *arguments, cwd=folder)
    assert result.returncode == 2
    assert said in result.stderr and "Traceback" not in result.stderr
