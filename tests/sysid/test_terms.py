"""Terms added to a model's equations: as a model that has them written out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks._stress_cases import MODEL, TRUTH, cases
from sysid import Constraint, Dataset, Input, ModelError, Output, Parameter, ProcessModel, State
from sysid.engine.simulation import BatchSimulator
from sysid.gassi import GASSI
from sysid.judging.alternatives import best_alternative
from sysid.judging.examination import suspected
from sysid.problem.terms import AddedTerm, with_terms
from tests.sysid.reference import simulate

POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (40, 2))
VALUES = tuple(TRUTH[name] for name in MODEL.parameter_names)
SHAPES = {
    "sign": lambda z: min(max(z, -1.0), 1.0),
    "linear": lambda z: z,
    "square": lambda z: math.copysign(z * z, z),
    "cube": lambda z: z**3,
    "abs": math.fabs,
    "parabola": lambda z: z**2,
    "sine": math.sin,
    "stribeck": lambda z: math.copysign(math.exp(-z * z), z),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_term_is_added_to_its_equation_alone(shape):
    term = AddedTerm("omega", "current", shape, 4.0, -10.0, 10.0, centre=0.5)
    extended = with_terms(MODEL, [term])
    assert extended.parameter_names[-1] == f"{shape}_of_current_in_omega"
    assert extended.parameters[-1].unit == "rad/s^2"
    for x in map(tuple, POINTS.tolist()):
        plain = MODEL.derivative(x, (3.0, 0.01), VALUES)
        rates = extended.derivative(x, (3.0, 0.01), (*VALUES, 7.0))
        assert rates[0] == plain[0]
        added = 7.0 * SHAPES[shape]((x[0] - 0.5) / 4.0)
        assert rates[1] - plain[1] == pytest.approx(added, abs=1e-9 * abs(plain[1]))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_term_of_a_parameter_multiplies_it_in_all_equations(shape):
    """By its own part of one of them: of R, of the voltage it takes in the winding's."""
    extended = with_terms(MODEL, [AddedTerm("current", "R", shape, 900.0, -1.0, 9.0)])
    assert extended.parameter_names[-1] == f"{shape}_of_R_in_current"
    assert extended.parameters[-1].unit == "1"
    place, inductance = MODEL.parameter_names.index("R"), TRUTH["L"]
    for x in map(tuple, POINTS.tolist()):
        part = -TRUTH["R"] * x[0] / inductance
        if abs(part) < 9.0:  # where a shape has a slope for a jump
            continue
        factor = max(1.0 + 0.7 * SHAPES[shape](part / 900.0), 1e-3)
        values = (*VALUES[:place], factor * TRUTH["R"], *VALUES[place + 1 :])
        rates = extended.derivative(x, (3.0, 0.01), (*VALUES, 0.7))
        assert rates == pytest.approx(MODEL.derivative(x, (3.0, 0.01), values), rel=1e-6)


@pytest.mark.soak
def test_a_term_is_added_to_equations_that_nothing_can_follow():
    """NumPy's sign is compiled as it is, with what is added to the last equation behind it."""

    def derivative(x, u, p):
        return x[1], u[0] - p[0] * x[1] - p[1] * np.sign(x[0])

    def written_out(x, u, p):
        rates = derivative(x, u, p)
        return rates[0], rates[1] + p[2] * min(max(x[1] / 0.5, -1.0), 1.0)

    model = replace(sprung(), derivative=derivative)
    term = AddedTerm("v", "v", "sign", 0.5, -2.0, 0.0)
    extended = with_terms(model, [term])
    record = Dataset(np.sin(np.arange(60) / 5.0), np.ones(60), 0.05)
    values = np.array([[0.3, 0.4, -0.8]])
    expected = BatchSimulator(replace(extended, derivative=written_out)).trajectories(
        values, record
    )
    found = BatchSimulator(extended).trajectories(values, record)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert np.ptp(found) > 0.1


def sprung():
    return ProcessModel(
        name="sprung",
        states=(State("q", "m", 0.2), State("v", "m/s")),
        inputs=(Input("u", "N"),),
        outputs=(Output("q", "m"),),
        parameters=(Parameter("d", "1/s", 0.3, 0.0, 1.0), Parameter("c", "N", 1.5, 0.1, 5.0)),
        derivative=lambda x, u, p: (x[1], u[0] - p[0] * x[1] - p[1] * x[0]),
    )


def test_outputs_constraints_and_variants_stay_those_of_the_models_own_parameters():
    def load(x, u, p):
        R, _, K, _, _ = p
        return (R * x[0] + K * x[1],)

    model = replace(
        MODEL.with_outputs(["current"]),
        output=load,
        constraints=(Constraint("R <= 5", lambda p: dict(enumerate(p))[len(p) - 5] - 5.0),),
        variants=lambda: {"twin": MODEL},
    )
    terms = [
        AddedTerm("omega", "omega", "sign", 0.1, -10.0, 10.0),
        AddedTerm("omega", "omega", "cube", 50.0, -10.0, 10.0),
    ]
    extended, values = with_terms(model, terms), (*VALUES, 1.0, 2.0)
    assert extended.output((1.0, 2.0), (0.0, 0.0), values) == load((1.0, 2.0), (), VALUES)
    assert extended.constraints[0].function(values) == VALUES[0] - 5.0
    assert extended.variants()["twin"].parameter_names[-2:] == ("sign_of_omega", "cube_of_omega")


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (AddedTerm("speed", "omega", "sign", 0.1, -1.0, 1.0), "no state 'speed'"),
        (
            AddedTerm("omega", "speed", "sign", 0.1, -1.0, 1.0),
            "no state, input or parameter 'speed'",
        ),
        (AddedTerm("omega", "omega", "sign", 0.0, -1.0, 1.0), "must be above 0"),
        (AddedTerm("omega", "omega", "sign", 0.1, 1.0, -1.0), "low end at or above"),
    ],
)
def test_a_term_that_is_none_is_refused_in_words(term, words):
    with pytest.raises(ModelError, match=words):
        with_terms(MODEL, [term])
    right = AddedTerm("omega", "omega", "sign", 0.1, -1.0, 1.0)
    with pytest.raises(ModelError, match="repeat the name 'sign_of_omega'"):
        with_terms(MODEL, [right, right])


CASES = {case.name: case for case in cases()}


@pytest.mark.soak
def test_a_function_that_the_data_ask_for_is_fitted_and_ranked():
    (training,), validation = CASES["Coulomb friction"].records(0)
    estimator = GASSI(MODEL, population=60, generations=12).fit(training)
    suspicion = suspected(estimator, estimator.uncertainty([training]), [training], [validation])
    (term,), alternative = suspicion.alternative.terms, suspicion.alternative
    assert (term.equation, term.of, term.shape) == ("omega", "omega", "sign")
    assert alternative.better
    assert all(new > old for old, new in alternative.fits.values())
    # Damping as it is, now that friction has a term of its own.
    old, new, unit = alternative.values["B"]
    assert old > 2.0 * TRUTH["B"] and unit == "N*m*s/rad"
    assert new == pytest.approx(TRUTH["B"], rel=0.3)


@pytest.mark.soak
def test_friction_that_grows_towards_standstill_is_told_from_dry_friction():
    case = CASES["Stribeck beside Coulomb"]
    (training,), validation = case.records(0)
    estimator = GASSI(case.model, population=60, generations=12).fit(training)
    uncertainty = estimator.uncertainty([training])
    suspicion = suspected(estimator, uncertainty, [training], [validation])
    (term,) = suspicion.alternative.terms
    assert (term.shape, suspicion.alternative.better) == ("stribeck", True)
    assert best_alternative((), estimator, uncertainty, [training]) is None


def test_a_model_with_a_term_moves_as_one_with_the_function_written_out():
    """By SciPy, of a dry friction that is written by hand."""
    (record,), _ = CASES["motor"].records(0)
    record = Dataset(record.inputs[:100], np.zeros((100, 2)), record.dt)

    def rubbing(x, u, p):
        rates = MODEL.derivative(x, u, p)
        return (rates[0], rates[1] - 130.0 * math.tanh(x[1] / 0.05))

    by_hand = simulate(replace(MODEL, derivative=rubbing), np.array(VALUES), record)
    extended = with_terms(MODEL, [AddedTerm("omega", "omega", "sign", 0.05, -500.0, 0.0)])
    by_term = simulate(extended, np.array([*VALUES, -130.0]), record)
    assert np.abs(by_term - by_hand).max() < 5e-3 * np.abs(by_hand).max()
