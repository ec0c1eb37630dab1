"""How a filter's innovations answer disturbances, against filters of disturbed records."""

from dataclasses import replace

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset
from sysid.engine.filter_settings import FilterSettings
from sysid.examples import lag

DT, TAU, GAIN, SAMPLES = 0.02, 0.05, 2.0, 200
NOISE, INSTANTS = np.array([0.1]), np.zeros(0)


def noisy_record(windows=INSTANTS):
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, SAMPLES))
    y[[50, 51]] = np.nan
    return Dataset(u, y, DT, input_noise=np.array([0.3]), windows=windows)


def means_over_the_last_sample():
    return np.sort(np.random.default_rng(1).uniform(-DT, 0.0, (SAMPLES, 1, 2)), axis=2)


def filtered(record, vector=(GAIN, TAU), corrects=True, colour=0.5, hold="zoh", shift=0.0):
    """Innovations (n_samples, 1), and the response, of a model that starts as declared."""
    model = lag().with_holds({"u": hold}).with_initial({"y": 0.0})
    simulator = BatchSimulator(model, threads=1)
    vector, scale, start = np.array(vector), np.ones(1), np.zeros(1)
    jitter = {"scatter": 1.5 * shift**2, "shift": shift, "jitter_colour": 0.9}
    settings = FilterSettings(NOISE, colour=np.array([colour]), corrects=corrects, **jitter)
    innovations = simulator.innovations(
        vector[None], [record], [scale], np.array([[2]]), [start[None]], [settings]
    ).values[..., 0]  # fmt: skip
    response = simulator.filter_response(vector, record, scale, 2, start, settings)
    return innovations, response


@pytest.mark.parametrize(("hold", "colour"), [("zoh", 0.0), ("zoh", 0.5), ("foh", 0.5)])
@pytest.mark.parametrize("windows", [INSTANTS, means_over_the_last_sample()])
def test_outputs_and_rates_are_answered_as_by_filters_that_have_them(windows, hold, colour):
    """The lag is linear: its innovations change in proportion, however much is added."""
    shift = 0.0 if windows is INSTANTS else 0.2 * np.sin(np.arange(float(SAMPLES)))[:, None]
    record, settings = noisy_record(windows), {"hold": hold, "colour": colour, "shift": shift}
    before, response = filtered(record, **settings)
    added = np.sin(0.3 * np.arange(SAMPLES))[:, None]
    # What is foreseen too high by that was measured too low.
    low, _ = filtered(replace(record, outputs=record.outputs - added), **settings)
    np.testing.assert_allclose(response.of(outputs=added), low - before, atol=1e-9)
    driven, _ = filtered(replace(record, inputs=record.inputs + added), **settings)
    np.testing.assert_allclose(response.of(inputs=added), driven - before, atol=1e-9)
    if hold == "foh":  # what an input that is straight in between adds to the rate
        rates = added * GAIN / TAU
        np.testing.assert_allclose(response.of(rates=rates), driven - before, atol=1e-9)


@pytest.mark.parametrize("windows", [INSTANTS, means_over_the_last_sample()])
def test_without_corrections_it_is_that_of_a_free_run(windows):
    record, vector = noisy_record(windows), np.array([GAIN, TAU])
    _, response = filtered(record, corrects=False)
    runs = BatchSimulator(lag().with_initial({"y": 0.0}), accuracy=1e-9)
    for along in np.eye(2):
        step = 1e-5 * along * vector
        up, down = runs.trajectories(np.array([vector + step, vector - step]), record)
        slope = (up - down)[:, 0] / 2e-5
        # Innovations are errors in parts of their deviation, of which the noise makes a part.
        seen = np.isfinite(record.outputs[:, 0]) & (response.kept[:, 0] > 0.0)
        moved = response.of(vector=along * vector)[:, 0] / np.where(seen, response.kept[:, 0], 1.0)
        np.testing.assert_allclose(moved[seen], slope[seen], atol=1e-6 * np.abs(slope).max())


def test_states_are_foreseen_and_not_those_that_were_measured():
    """A sample moves what is foreseen of the later ones alone."""
    record = noisy_record()
    outputs = record.outputs.copy()
    outputs[100] += 1.0
    states, moved = (
        filtered(r)[1].states[:, 0] for r in (record, replace(record, outputs=outputs))
    )
    assert np.array_equal(states[:101], moved[:101]) and states[101] != moved[101]


def test_a_start_elsewhere_is_forgotten_as_outputs_correct_it():
    _, corrected = filtered(noisy_record())
    _, free = filtered(noisy_record(), corrects=False)
    first, later = 1, 10
    changes = [
        r.of(start=np.ones(1))[:, 0] / np.maximum(r.kept[:, 0], 1e-12) for r in (corrected, free)
    ]
    decay = np.exp(-DT / TAU)
    assert changes[1][first] == pytest.approx(decay, rel=1e-6)
    assert changes[1][later] == pytest.approx(decay**10, rel=1e-6)
    assert abs(changes[0][later]) < 0.5 * abs(changes[1][later])


def test_balance_by_the_process_is_the_mean_deviation_that_the_response_tells():
    """However coarse the integration of a bent equation is."""
    bent = replace(
        lag(), name="bent", derivative=lambda x, u, p: ((p[0] * u[0] - x[0] * abs(x[0])) / p[1],)
    )
    simulator, record = BatchSimulator(bent, threads=1), noisy_record()
    vector, scale, start, process = np.array([GAIN, TAU]), np.ones(1), np.zeros(1), np.array([0.5])
    settings = FilterSettings(NOISE, process=process)
    plain, balanced = (
        simulator.innovations(
            vector[None], [record], [scale], np.array([[1]]), [start[None]], [settings],
            balanced=wanted,
        ).values[..., 0]
        for wanted in (False, True)
    )  # fmt: skip
    response = simulator.filter_response(vector, record, scale, 1, start, settings)
    seen = (plain != 0.0) & (response.kept > 0.0)
    deviation = np.exp(-np.sum(np.log(response.kept[seen])) / np.isfinite(record.outputs).sum())
    np.testing.assert_allclose(balanced[seen] / plain[seen], deviation, rtol=1e-6)
