"""What the equations tie: kept on disk between runs, and no distance between minima."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from sysid import (
    BatchSimulator,
    Dataset,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.objective import Objective
from sysid.identifiability import cache
from sysid.identifiability.cache import kept_identifiability
from sysid.uncertainty.draws import plausible_parameters
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import ties


def shaft_derivative(x, u, p):
    return ((u[0] - p[2] * x[0]) / (p[0] + p[1]),)


def heavier_derivative(x, u, p):
    return ((u[0] - p[2] * p[0] * x[0]) / (p[0] + p[1]),)


def shaft(**changes):
    names = ("J_m", "kg*m^2"), ("J_b", "kg*m^2"), ("B", "N*m*s/rad")
    settings = {
        "name": "shaft",
        "states": (State("omega", "rad/s"),),
        "inputs": (Input("torque", "N*m"),),
        "outputs": (Output("omega", "rad/s"),),
        "parameters": tuple(Parameter(name, unit, 1.0, 0.01, 100.0, "log") for name, unit in names),
        "derivative": shaft_derivative,
    }
    return ProcessModel(**(settings | changes))


@pytest.fixture
def analyses(monkeypatch, tmp_path):
    """Models that are analysed, with a cache folder that begins empty."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("RIG_CACHE_DIR", str(tmp_path))
    models, analyse = [], cache.identifiability

    def counted(model, **options):
        models.append(model)
        return analyse(model, **options)

    monkeypatch.setattr(cache, "identifiability", counted)
    return models


def combinations(result):
    return [combination.text for group in result.tied for combination in group.combinations]


def test_the_same_equations_are_analysed_once(analyses):
    first, second = kept_identifiability(shaft()), kept_identifiability(shaft())
    assert len(analyses) == 1
    assert combinations(first) == combinations(second) == ["J_m + J_b"]
    np.testing.assert_array_equal(first.tied[0].directions, second.tied[0].directions)


@pytest.mark.parametrize(
    "changed",
    [
        shaft(derivative=heavier_derivative),
        shaft().with_parameters(J_b={"fixed": True}),
        shaft().with_parameters(B={"nominal": 2.0}),
        replace(shaft(), states=(State("omega", "rad/s", initial_range=(-1.0, 1.0)),)),
    ],
    ids=["equations", "fixed", "nominal", "start"],
)
def test_whatever_changes_in_a_model_it_is_analysed_anew(analyses, changed):
    kept_identifiability(shaft())
    kept_identifiability(changed)
    assert len(analyses) == 2


def test_a_file_that_was_cut_short_is_made_anew(analyses, tmp_path):
    kept_identifiability(shaft())
    (file,) = tmp_path.glob("identifiability_*.pickle")
    file.write_bytes(file.read_bytes()[:-20])
    assert combinations(kept_identifiability(shaft())) == ["J_m + J_b"]
    kept_identifiability(shaft())
    assert len(analyses) == 2  # the second time it was whole again


def test_a_process_model_is_made_without_what_identifies_it():
    code = (
        "import sys; from sysid import ProcessModel, State; "
        "heavy = ('sklearn', 'scipy', 'joblib', 'numba', 'flint'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_draws_keep_what_the_outputs_determine_however_far_the_others_go():
    # J_m - J_b is hardly known, their sum to 1 %, B to 2 %.
    apart = np.array([[0.8, -0.8, 0.0], [0.01, 0.01, 0.0], [0.0, 0.0, 0.02]])
    vector = np.array([1.0, 1.0, 1.0])
    drawn = plausible_parameters(shaft(), vector, shaft().parameter_names, apart, 4000, seed=0)
    assert len(drawn) == 4000 and (drawn > 0.0).all()
    total, (low, high) = drawn[:, 0] + drawn[:, 1], np.quantile(drawn[:, 0], [0.025, 0.975])
    assert total.mean() == pytest.approx(2.0, rel=1e-3)
    assert total.std() == pytest.approx(0.02, rel=0.1)  # as the covariance has it
    assert drawn[:, 2].std() == pytest.approx(0.02, rel=0.1)
    assert low < 0.4 and high > 1.6


def test_what_the_equations_tie_no_jump_of_a_single_parameter_unties():
    """A sample on the very edge of a switch: any change of one inertia alone moves it by two."""
    edge = shaft(
        outputs=(Output("omega", "rad/s"), Output("fast", "1")),
        parameters=tuple(
            Parameter(name, unit, value, 0.01, 100.0, "log")
            for name, unit, value in (("J_m", "kg*m^2", 0.25), ("J_b", "kg*m^2", 0.75))
        ),
        derivative=lambda x, u, p: (u[0] / (p[0] + p[1]),),
        output=lambda x, u, p: (x[0], 1.0 if x[0] > 0.5 else -1.0),
    )
    inputs, dt = np.ones((17, 1)), 0.0625  # omega is 0.5 at the ninth sample, to the bit
    speed = dt * np.arange(17.0)
    record = Dataset(inputs, np.column_stack([speed, np.sign(speed - 0.4)]), dt)
    objective = Objective(BatchSimulator(edge), SearchSpace.of(edge), [record])
    local = sensitivity(objective, edge.nominal)
    own = np.linalg.norm(local.rows, axis=0)
    assert np.linalg.norm(local.rows @ [1.0, -1.0 / 3.0]) > 0.5 * own.max()
    (direction,) = ties(local).directions
    assert direction[0] * 0.25 == pytest.approx(-direction[1] * 0.75)
