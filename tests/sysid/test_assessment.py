"""The verdict: each reason when its cause is there, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.judging.assessment import examine, judge
from sysid.uncertainty import Ambiguity, Estimate, Uncertainty

MODEL = ProcessModel(
    name="pair",
    states=(State("speed", "1"), State("current", "1")),
    inputs=(Input("volts", "1"), Input("load", "1")),
    outputs=(Output("speed", "1"), Output("current", "1")),
    parameters=(Parameter("k", "1", 1.0, 0.1, 10.0),),
    derivative=lambda x, u, p: (-x[0], -x[1]),
)
NOISE = 0.05
N = 600


def record(seed, name="log", size=1.0, **noise):
    """Outputs that are the inputs, times ``size``."""
    u = np.random.default_rng([seed, 1]).standard_normal((N, 2))
    return Dataset(u, size * u, 0.01, name, **noise)


def result(seed, error=(NOISE, NOISE), left=0.0, size=1.0, **noise):
    """What a model does that errs by white noise, and in the speed by a share of the load."""
    data = record(seed, size=size, **noise)
    wrong = np.random.default_rng([seed, 2]).standard_normal((N, 2)) * error
    wrong[:, 0] += left * data.inputs[:, 1]
    return examine(data, data.outputs - wrong)


def estimate(name, why=""):
    if why == "bound":
        return Estimate(name, "1", 1.0, high=1.2, on_bound=True)
    interval = (None, None, None) if why else (0.1, 0.8, 1.2)
    return Estimate(name, "1", 1.0, *interval, why=why)


def told(*whys):
    parameters = tuple(estimate(f"p{i}", why) for i, why in enumerate(whys))
    n = len(whys)
    vague = Ambiguity("tied", ("p0",), (), ("p0",))
    return Uncertainty(parameters, (vague,), np.eye(n), np.ones(n), n)


def verdict(training=None, validation=None, uncertainty=None, feasible=True):
    training = [result(1)] if training is None else training
    validation = [result(2)] if validation is None else validation
    return judge(MODEL, training, validation, uncertainty or told("", ""), feasible)


def test_examine_measures_each_record_with_its_own_scale_and_inputs():
    records = [record(1, "a"), record(2, "b", size=3.0, input_noise=np.array([0.0, 0.1]))]
    first, second = (examine(r, 0.9 * r.outputs) for r in records)
    assert (first.name, second.name) == ("a", "b")
    np.testing.assert_allclose(second.metrics.scale, np.abs(records[1].outputs).max(axis=0))
    np.testing.assert_allclose(first.metrics.fit, 90.0, atol=0.1)
    np.testing.assert_array_equal(second.residuals.tested, [True, False])
    # Measured minus simulated: what is left has the sign of what drives it.
    assert first.residuals.cross[0, 0, 0] == pytest.approx(1.0)


def test_nothing_wrong_is_good():
    found = verdict()
    assert found.trust == "good"
    (reason,) = found.reasons
    fit = np.mean(result(2).metrics.fit)
    assert f"mean fit {fit:.1f} %" in reason


@pytest.mark.parametrize("uncertainty", [None, told("tied", "vague")])
def test_what_is_tied_or_hardly_felt_is_no_reason_to_doubt_the_rest(uncertainty):
    assert judge(MODEL, [result(1)], [result(2)], uncertainty).trust == "good"


def test_parameters_that_break_constraints_are_named_first():
    found = verdict(validation=[], feasible=False)
    assert found.trust == "poor" and len(found.reasons) == 2
    assert "constraints" in found.reasons[0]


def test_an_output_that_is_hardly_explained_is_poor():
    found = verdict([result(1, (0.6, NOISE))], [result(2, (0.6, NOISE))])
    assert found.trust == "poor"
    assert found.reasons == ("speed is explained poorly on the validation data (fit 36 %).",)
    # As poor, and worse than in training: one reason is enough.
    assert verdict(validation=[result(2, (0.6, NOISE))]).reasons == found.reasons


@pytest.mark.parametrize(
    "ratio, trust",
    [(0.3, "good"), (1.2, "good"), (1.45, "limited"), (1.9, "limited"), (2.2, "poor")],
)
def test_errors_that_grow_in_validation_count_by_how_much(ratio, trust):
    found = verdict(validation=[result(2, (NOISE, ratio * NOISE))])
    assert found.trust == trust
    if trust != "good":
        (reason,) = found.reasons
        assert reason.startswith("current errs ") and reason.endswith(
            " times as much in validation as in training."
        )
        assert float(reason.split()[2]) == pytest.approx(ratio, abs=0.15)


def test_errors_are_compared_in_their_own_unit_over_all_records():
    # The validation is ten times smaller; its error in parts of its peak ten times larger.
    small = result(2, (NOISE, NOISE), size=0.5)
    large = result(1, size=5.0)
    assert small.metrics.rmse[0] > 5.0 * large.metrics.rmse[0]
    assert verdict([large], [small]).trust == "good"
    # Root mean square of 0.5, 1 and 3 parts is 1.85.
    several = [result(k, (NOISE, part * NOISE)) for k, part in enumerate((0.5, 1.0, 3.0), 2)]
    (reason,) = verdict(validation=several).reasons
    assert float(reason.split()[2]) == pytest.approx(1.85, abs=0.1)


def test_without_validation_the_verdict_is_limited():
    found = verdict(validation=[])
    assert found.trust == "limited"
    assert found.reasons == (
        "No data were held back for validation: the errors are those of the fit.",
    )


def test_what_follows_an_input_is_named():
    found = verdict([result(1, left=0.2)], [result(2, left=0.2)])
    assert found.trust == "good", "one lag of fifty is chance"

    def slow(seed):
        """The speed lacks a slow response to the load."""
        data = record(seed)
        wrong = NOISE * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        wrong[:, 0] += lfilter([0.03], [1.0, -0.9], data.inputs[:, 1])
        return examine(data, data.outputs - wrong)

    found = verdict([slow(1)], [slow(2)])
    assert found.trust == "limited"
    assert found.reasons == (
        "Residuals of speed still follow load: the model lacks dynamics there.",
    )
    # Seen in validation only, or in training for want of validation.
    assert "follow load" in verdict([slow(1)], []).reasons[1]
    assert "follow" not in " ".join(verdict([slow(1)], [result(2)]).reasons)
    # In the mean of the records: of many, one or another is outside its bands by chance.
    assert "follow load" in verdict([slow(1)], [slow(2), slow(3), slow(4)]).reasons[0]
    assert verdict([slow(1)], [slow(2), *(result(k) for k in range(3, 7))]).trust == "good"


def test_a_trace_of_an_input_in_a_long_record_is_nothing_to_mend():
    def long(part):
        n = 20_000
        slow = np.sin(np.arange(n) / 300.0)[:, None] * [1.0, 1.0]
        data = Dataset(slow, slow + 0.5, 0.01, "long")
        wrong = NOISE * (np.random.default_rng(6).standard_normal((n, 2)) + part * slow)
        return examine(data, data.outputs - wrong)

    trace, much = long(0.07), long(0.3)
    assert np.all(trace.residuals.independent < 0.1)
    told = verdict([trace], [trace])
    assert told.trust == "good" and "no more than a trace is left" in told.reasons[0]
    assert "follow" in verdict([much], [much]).reasons[0]


def test_an_error_several_times_as_large_may_still_be_a_small_one():
    found = verdict([result(1, (1e-4, 1e-4))], [result(2, (1e-4, 4e-4))])
    assert found.trust == "limited"
    assert found.reasons[0].startswith("current errs ")


def test_what_follows_a_noisy_input_is_not_held_against_the_model():
    noise = {"input_noise": np.array([0.0, 0.3])}
    data = record(3, **noise)
    wrong = 0.1 * np.cumsum(data.inputs[:, [1, 1]], axis=0)
    found = examine(data, data.outputs - wrong)
    assert "follow" not in " ".join(judge(MODEL, [found], [found], None).reasons)


@pytest.mark.parametrize(
    "whys, text",
    [
        (("bound", ""), "p0 stands on an end of the range: widen it, or fix the value."),
        (("bound", "bound"), "p0, p1 stand on an end of the range: widen it, or fix the value."),
    ],
)
def test_a_parameter_at_an_end_of_its_range_limits(whys, text):
    found = verdict(uncertainty=told(*whys))
    assert (found.trust, found.reasons) == ("limited", (text,))


def test_grave_reasons_come_before_light_ones():
    found = verdict(
        validation=[result(2, (0.6, 1.5 * NOISE))], uncertainty=told("bound"), feasible=False
    )
    assert found.trust == "poor"
    words = ("constraints", "speed is explained poorly", "current errs", "p0 stands")
    assert len(found.reasons) == 4
    assert all(word in reason for word, reason in zip(words, found.reasons, strict=True))


def test_an_output_that_never_changes_or_was_never_measured_is_no_reason():
    for value in (0.7, np.nan):
        data = record(2)
        simulated = data.outputs + NOISE * np.random.default_rng(5).standard_normal((N, 2))
        outputs = data.outputs.copy()
        outputs[:, 1] = value
        simulated[:, 1] = 0.7
        found = examine(replace(data, outputs=outputs), simulated)
        assert verdict(validation=[found]).trust == "good"


def test_a_free_run_that_fails_is_no_proof_of_anything():
    data = record(2, "failing")
    failed = examine(data, np.full_like(data.outputs, np.nan))
    for validation in ([failed], [result(3), failed]):
        found = verdict(validation=validation)
        assert found.trust == "poor"
        assert "failing" in found.reasons[0] and "cannot be simulated" in found.reasons[0]


@pytest.mark.parametrize(
    ("size", "pole", "trust"),
    [(0.4, 0.98, "limited"), (0.4, 0.0, "good"), (0.15, 0.98, "good")],
    ids=["much that wanders", "much that is white", "little that wanders"],
)
def test_much_that_wanders_makes_parameters_doubtful(size, pole, trust):
    def slow(seed):
        data = record(seed)
        noise = np.random.default_rng([seed, 3]).standard_normal((N, 2))
        wrong = lfilter([1.0], [1.0, -pole], noise, axis=0)
        wrong -= wrong.mean(axis=0)
        wrong *= [size, NOISE] / wrong.std(axis=0)
        return examine(data, data.outputs - wrong)

    found = verdict([slow(1)], [slow(2)])
    assert found.trust == trust, found.reasons
    if trust == "limited":
        (reason,) = found.reasons
        assert " % of speed's variance is left, and wanders" in reason
