"""Records under feedback: noise that the controller answers is no missing term, and is told."""

import dataclasses

import numpy as np
import pytest

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.gassi import GASSI
from sysid.judging.disturbed import DisturbedRun, Rates, delayed
from sysid.judging.examination import suspected, verdict_of
from sysid.threads import Workers
from tests.soak import mostly_soak
from tests.sysid.support import held_lag

RATE, GAIN, DT = 3.0, 6.0, 0.01
LAG = ProcessModel(
    name="lag",
    states=(State("y", "1", initial_range=(-1, 1)),),
    inputs=(Input("u", "1"),),
    outputs=(Output("y", "1"),),
    parameters=(
        Parameter("a", "1/s", 5.0, 0.3, 30.0, "log"),
        Parameter("b", "1/s", 10.0, 0.6, 60.0, "log"),
    ),
    derivative=lambda x, u, p: (p[1] * u[0] - p[0] * x[0],),
)


def controlled(seed, place, memory, size=0.2, n=4000):
    """A lag under proportional feedback, its input disturbed by noise of so many samples' memory.

    Without a memory the noise is the sensor's.
    """
    rng = np.random.default_rng([seed, place])
    lengths = rng.integers(30, 120, n // 30)
    reference = np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:n]
    pole, onward = np.exp(-RATE * DT), np.exp(-1.0 / memory) if memory else 0.0
    x, e, u, y = 0.0, 0.0, np.empty(n), np.empty(n)
    for k in range(n):
        e = onward * e + np.sqrt(1.0 - onward**2) * rng.standard_normal()
        y[k] = x + (2e-3 if memory else 0.05) * rng.standard_normal()
        u[k] = 4.0 * (reference[k] - y[k])
        x = pole * x + (1.0 - pole) * GAIN / RATE * (u[k] + (size * e if memory else 0.0))
    return Dataset(u, y, DT, f"place {place}")


def fitted(record, seed):
    return GASSI(LAG, population=60, generations=14, random_state=seed).fit(record)


@pytest.mark.parametrize("seed", mostly_soak([1, 2, 3, 4]))
def test_what_a_controller_answers_is_named_and_nothing_else_with_what_it_has_moved(seed):
    """In each of these a term in the sign of u had been named, with p < 1e-7."""
    record = controlled(seed, 1, 5.0)
    estimator = fitted(record, seed)
    findings = suspected(estimator, estimator.uncertainty(record), [record]).findings
    assert [(f.kind, f.name) for f in findings] in (
        [("feedback", "u")],
        [],
    )
    for move in (move for finding in findings for move in finding.moves):
        truth = {"a": RATE, "b": GAIN}.get(move.quantity.name)
        if truth is not None and abs(move.deviations) > 1.5:
            off = abs(move.quantity.value - truth)
            assert abs(move.quantity.value + move.change - truth) < 0.5 * off


def test_a_planned_input_answers_nothing_however_it_looks():
    record = controlled(1, 1, 5.0)
    estimator = fitted(record, 1)
    uncertainty = estimator.uncertainty(record)
    for planned in (False, True):
        told = dataclasses.replace(record, planned=planned)
        findings = suspected(estimator, uncertainty, [told]).findings
        assert any(f.kind == "feedback" for f in findings) != planned


def test_noise_without_a_memory_moves_nothing_under_feedback():
    records = [controlled(0, place, 0.0) for place in (1, 2)]
    verdict = verdict_of(fitted(records[0], 0), records[:1], records[1:])
    assert verdict.trust == "good", verdict.reasons


def test_what_acts_with_a_held_input_does_not_act_before_it():
    """Else noise that the input answers would go with what a term in it does."""
    record = controlled(0, 1, 5.0, n=50)
    run = DisturbedRun.free(LAG, np.array([RATE, GAIN]), record, np.zeros(1), 4, Workers(1))
    jump = np.zeros((50, 1))
    jump[20:] = 1.0
    change = run.added(Rates(jump, delayed(jump)))[:, 0]
    assert not change[:21].any()
    expected = (1.0 - np.exp(-RATE * DT * np.arange(30))) / RATE
    np.testing.assert_allclose(change[20:], expected, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize(
    ("samples", "tolerance"), [(-0.02, 0.05), (-1.0, 1e-3), (-1.1, 0.05), (0.05, 0.1), (2.0, 1e-3)]
)
def test_what_a_held_input_has_done_before_or_after_is_what_fast_states_keep_of_it(
    samples, tolerance
):
    """A plant that forgets seven eighths of what was at the begin of a sample by its end."""
    rng, n, rate = np.random.default_rng(0), 60, 210.0
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 6), 6)
    u[:6] = u[-6:] = 0.0
    pole = np.exp(-rate * DT)

    def response(shift):
        return held_lag(u, shift, 1.0, 1.0 / (rate * DT))

    record = Dataset(u, response(0.0), DT)
    run = DisturbedRun.free(LAG, np.array([rate, rate]), record, np.zeros(1), 4, Workers(1))
    assert run.outputs[:, 0] == pytest.approx(response(0.0), abs=1e-9)
    moved = response(samples) - response(0.0)
    assert 0.0 < pole < 0.13
    error = run.acted_before(0, u, samples * DT)[:, 0] - moved
    assert np.linalg.norm(error) < tolerance * np.linalg.norm(moved)
