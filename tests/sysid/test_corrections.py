"""Gains, offsets and drifts of channels: as a model that has them written out, and found."""

import dataclasses

import numpy as np
import pytest

from benchmarks._stress_cases import MODEL, TRUTH, cases
from benchmarks.stress import tried
from sysid import BatchSimulator, ModelError
from sysid.gassi import GASSI
from sysid.problem.corrections import Correction, with_corrections

VALUES = tuple(TRUTH[name] for name in MODEL.parameter_names)
POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (20, 4)).tolist()
BOTH = [Correction("voltage", "gain", 0.5, 2.0), Correction("omega", "offset", -3.0, 3.0)]


def test_an_input_is_corrected_before_the_equations_and_an_output_behind_them():
    corrected = with_corrections(MODEL, BOTH)
    assert corrected.parameter_names[-2:] == ("gain_of_voltage", "offset_of_omega")
    assert [p.unit for p in corrected.parameters[-2:]] == ["1", "rad/s"]
    for i, omega, voltage, load in POINTS:
        values = (*VALUES, 1.3, -0.7)
        rates = corrected.derivative((i, omega), (voltage, load), values)
        assert rates == MODEL.derivative((i, omega), (1.3 * voltage, load), VALUES)
        assert corrected.output((i, omega), (voltage, load), values) == (i, omega - 0.7)


def test_an_output_function_sees_the_corrected_input_too():
    straight = dataclasses.replace(
        MODEL.with_outputs(["current"]), output=lambda x, u, p: (p[0] * x[0] - u[0],)
    )
    corrected = with_corrections(straight, [BOTH[0], Correction("current", "gain", 0.5, 2.0)])
    (given,) = corrected.output((2.0, 0.0), (3.0, 0.0), (*VALUES, 1.5, 0.8))
    assert given == pytest.approx(0.8 * (VALUES[0] * 2.0 - 4.5))


def test_a_drift_grows_from_the_first_sample_of_every_record():
    drifts = [Correction("load", "drift", -1.0, 1.0), Correction("omega", "drift", -1.0, 1.0)]
    corrected = with_corrections(MODEL, drifts)
    assert corrected.state_names == ("current", "omega", "time_of_record")
    assert [p.unit for p in corrected.parameters[-2:]] == ["N*m/s", "rad/s/s"]
    (record,), _ = {case.name: case for case in cases()}["motor"].records(0)
    vector = np.array([*VALUES, 0.03, -2.0])
    (whole,) = BatchSimulator(corrected).trajectories(vector[None], record)
    time = record.dt * np.arange(record.n_samples)
    # A load on a straight line between samples; the held one's steps are as small as samples.
    loads = record.inputs + np.outer(time + 0.5 * record.dt, [0.0, 0.03])
    there = dataclasses.replace(record, inputs=loads)
    (expected,) = BatchSimulator(MODEL).trajectories(np.array([VALUES]), there)
    expected[:, 1] -= 2.0 * time
    np.testing.assert_allclose(whole, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.soak
def test_a_drift_that_is_named_is_fitted_by_its_correction():
    case = {case.name: case for case in cases()}["load drifts"]
    outcome = tried(case, 0)
    assert outcome.verdict.parameters.reasons[0].startswith("load drifts by 0.0")
    corrected = with_corrections(MODEL, [Correction("load", "drift", -0.2, 0.2)])
    estimator = GASSI(corrected, population=60, generations=12).fit(case.records(0)[0])
    # The load was logged 0.05 N*m too high at the end of 1.5 s.
    assert estimator.parameters_["drift_of_load"] == pytest.approx(-0.05 / 1.5, rel=0.01)


@pytest.mark.parametrize(
    ("correction", "words"),
    [
        (Correction("speed", "gain", 0.5, 2.0), "no channel 'speed'; it has voltage"),
        (Correction("omega", "gain", 1.1, 2.0), "1.1 to 2, does not hold 1, which means no error"),
        (Correction("omega", "offset", 3.0, -3.0), "does not hold 0"),
    ],
)
def test_a_correction_of_what_is_not_there_is_refused_in_words(correction, words):
    with pytest.raises(ModelError, match=words):
        with_corrections(MODEL, [correction])
    with pytest.raises(ModelError, match="repeat the name 'gain_of_voltage'"):
        with_corrections(MODEL, [BOTH[0], BOTH[0]])


@pytest.mark.soak
def test_a_wrong_gain_is_found_with_the_parameters_as_they_are():
    (record,), _ = {case.name: case for case in cases()}["motor"].records(0)
    outputs = record.outputs.copy()
    column = MODEL.output_names.index("omega")
    outputs[:, column] *= 1.15
    wrong = dataclasses.replace(record, outputs=outputs)
    corrected = with_corrections(MODEL, [Correction("omega", "gain", 0.5, 2.0)])
    estimator = GASSI(corrected, population=60, generations=12).fit(wrong)
    found = estimator.parameters_
    assert found["gain_of_omega"] == pytest.approx(1.15, rel=0.01)
    for name in ("R", "K"):
        assert found[name] == pytest.approx(TRUTH[name], rel=0.03)
