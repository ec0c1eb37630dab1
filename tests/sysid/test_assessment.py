"""The verdict: each reason when its cause is there, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid import Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.gassi import GASSI
from sysid.judging.alternatives import Alternative
from sysid.judging.assessment import examine, judge
from sysid.judging.comparison import Comparison
from sysid.judging.expected_errors import ExpectedErrors
from sysid.judging.findings import Finding, Move
from sysid.problem.faults import DataFault
from sysid.problem.terms import AddedTerm
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


def wandering(seed, size, pole, current=NOISE):
    """What a model does that errs in the speed by so much, slowly."""
    data = record(seed)
    noise = np.random.default_rng([seed, 3]).standard_normal((N, 2))
    wrong = lfilter([1.0], [1.0, -pole], noise, axis=0)
    wrong -= wrong.mean(axis=0)
    wrong *= [size, current] / wrong.std(axis=0)
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
    sure = uncertainty or told("", "")
    return judge(MODEL, training, validation, sure, feasible, findings=())


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
    (reason,) = found.predicted.reasons
    assert "Nothing was found missing" in found.parameters.reasons[0]
    fit = np.mean(result(2).metrics.fit)
    assert f"mean fit {fit:.1f} %" in reason


def test_what_is_tied_or_hardly_felt_is_no_reason_to_doubt_the_rest():
    assert verdict(uncertainty=told("tied", "vague")).trust == "good"


def test_parameters_of_a_structure_that_was_not_tested_are_not_good():
    found = judge(MODEL, [result(1)], [result(2)], told("", ""), findings=None)
    assert (found.predicted.trust, found.parameters.trust) == ("good", "limited")
    assert "was not tested" in found.parameters.reasons[0]


def test_without_intervals_predictions_may_be_good_but_no_parameter_is_known():
    found = judge(MODEL, [result(1)], [result(2)], None)
    assert (found.predicted.trust, found.parameters.trust) == ("good", "limited")
    assert "no intervals" in found.parameters.reasons[0]


def test_parameters_that_break_constraints_are_named_first():
    found = verdict(validation=[], feasible=False)
    assert found.predicted.trust == found.parameters.trust == "poor" and len(found.reasons) == 2
    assert "constraints" in found.reasons[0]


def test_an_output_that_is_hardly_explained_is_poor():
    found = verdict([wandering(1, 0.6, 0.9)], [wandering(2, 0.6, 0.9)])
    assert found.trust == "poor"
    assert found.predicted.reasons == (
        "speed is explained poorly on the validation data (fit 39 %).",
    )
    assert "the parameters are not the plant's" in found.parameters.reasons[0]
    # As poor, and worse than in training: one reason is enough.
    assert verdict(validation=[wandering(2, 0.6, 0.9)]).reasons == found.reasons


def test_what_is_hardly_explained_where_it_was_fitted_is_poor_whatever_validation_says():
    found = verdict([wandering(1, 0.6, 0.9)], [result(2)])
    assert found.trust == "poor"
    assert found.predicted.reasons == (
        "speed is explained poorly even on the training data (fit 37 %).",
    )


@pytest.mark.parametrize(
    ("noise", "left", "trust"),
    [(0.6, 0.0, "limited"), (0.4, 0.0, "good"), (0.4, 0.4, "poor"), (0.95, 0.0, "poor")],
    ids=["white", "little of it", "from an input as well", "nothing but noise"],
)
def test_of_what_a_sensor_adds_no_model_explains_anything(noise, left, trust):
    """White, and going with no input: more is not to be had of such a sensor."""
    both = [result(seed, (noise, NOISE), left) for seed in (1, 2)]
    found = verdict(both[:1], both[1:])
    assert found.predicted.trust == trust
    if trust == "limited":
        assert found.predicted.reasons == (
            "speed is explained poorly on the validation data (fit 36 %), but what is left is "
            "white, as a sensor's noise is.",
        )
        assert found.parameters.trust == "good"


@pytest.mark.parametrize(
    "ratio, trust",
    [(0.3, "good"), (1.2, "good"), (1.45, "limited"), (1.9, "limited"), (2.2, "poor")],
)
def test_errors_that_grow_in_validation_count_by_how_much(ratio, trust):
    found = verdict(validation=[result(2, (NOISE, ratio * NOISE))])
    assert found.trust == trust
    if trust != "good":
        (reason,) = found.predicted.reasons
        assert reason.startswith("current errs ") and reason.endswith(
            " times as much in validation as in training."
        )
        assert float(reason.split()[2]) == pytest.approx(ratio, abs=0.15)


@pytest.mark.parametrize(("pole", "told"), [(0.0, True), (0.99, False)])
def test_errors_that_are_larger_by_chance_in_validation_are_no_reason(pole, told):
    # As if of 600 samples, and of three.
    judged = verdict([wandering(1, 0.1, pole)], [wandering(2, 0.14, pole)])
    worse = [r for r in judged.predicted.reasons if "speed errs 1.4 times as much in val" in r]
    assert bool(worse) == told


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
    assert verdict([result(1, left=0.005)], [result(2, left=0.005)]).trust == "good"
    at_once = verdict([result(1, left=0.3)], [result(2, left=0.3)])
    assert at_once.reasons[0].startswith("Residuals of speed still follow load"), "one lag of 50"

    def slow(seed):
        """The speed lacks a slow response to the load."""
        data = record(seed)
        wrong = NOISE * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        wrong[:, 0] += lfilter([0.03], [1.0, -0.9], data.inputs[:, 1])
        return examine(data, data.outputs - wrong)

    found = verdict([slow(1)], [slow(2)])
    assert found.trust == "limited"
    assert found.predicted.reasons == (
        "Residuals of speed still follow load: the model lacks dynamics there.",
    )
    assert "What is left of speed follows load" in found.parameters.reasons[0]
    # Seen in validation only, or in training for want of validation.
    assert "follow load" in verdict([slow(1)], []).reasons[1]
    assert "follow" not in " ".join(verdict([slow(1)], [result(2)]).reasons)
    assert "follow load" in verdict([slow(1)], [slow(2), slow(3), slow(4)]).reasons[0]
    # Of many records it is told of one, and of none by chance.
    right = [result(k) for k in range(3, 23)]
    assert verdict([slow(1)], right).trust == "good"
    assert "follows load" in verdict([slow(1)], [slow(2), *right[:4]]).reasons[0]


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
    assert told.trust == "good" and "no more than a trace" in told.reasons[0]
    assert "follow" in verdict([much], [much]).reasons[0]


def test_what_follows_an_input_is_no_noise_however_small():
    """Play at an encoder is next to nothing of its angle, but more than intervals tell."""

    def record(part, seed):
        slow = np.sin(np.arange(2000) / 30.0)[:, None] * [1.0, 1.0]
        data = Dataset(slow, slow + 0.5, 0.01, "play")
        noise = np.random.default_rng(seed).standard_normal((2000, 2))
        return examine(data, data.outputs - 1e-3 * (noise + part * slow))

    play = verdict([record(1.5, 1)], [record(1.5, 2)])
    assert play.predicted.trust == "good" and "no more than a trace" in play.predicted.reasons[0]
    assert play.parameters.trust == "limited" and "follows" in play.parameters.reasons[0]
    assert verdict([record(0.15, 1)], [record(0.15, 2)]).trust == "good"


@pytest.mark.parametrize("size", [1e-4, 1e-16])
def test_an_error_several_times_as_large_may_still_be_a_small_one(size):
    assert verdict([result(1, (size, size))], [result(2, (size, 4 * size))]).trust == "good"


def expected(noise, data, **systematic):
    nothing, none = np.zeros((*data.outputs.shape, 0)), np.zeros(data.outputs.shape)
    errors, passed_on = systematic.get("errors", nothing), systematic.get("passed_on", none)
    by_parameters = errors.shape[2]
    return ExpectedErrors(np.array(noise), np.zeros(len(noise)), errors, passed_on, by_parameters)


def test_errors_of_the_noise_alone_are_no_fault_however_large():
    def noisy(seed):
        data = record(seed)
        wrong = 0.6 * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        return examine(data, data.outputs - wrong, expected([0.36, 0.36], data))

    found = verdict([noisy(1)], [noisy(2)])
    assert found.trust == "good" and "speed, current down to the noise" in found.reasons[0]


def test_errors_above_the_noise_make_parameters_doubtful_and_predictions_not():
    def above(seed, wrong_by):
        data = record(seed)
        wrong = NOISE * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        wrong[:, 0] *= wrong_by
        return examine(data, data.outputs - wrong, expected([NOISE**2, NOISE**2], data))

    found = verdict([above(1, 1.5)], [above(2, 1.5)])
    assert (found.predicted.trust, found.parameters.trust) == ("good", "limited")
    assert found.parameters.reasons[0].startswith("speed errs 1.")
    assert verdict([above(1, 1.1)], [above(2, 1.1)]).trust == "good"
    # Without a calibration of the current that of the speed is tested all the same.
    data = record(2)
    unknown = examine(data, data.outputs + NOISE, expected([NOISE**2, np.nan], data))
    assert (
        "noise of current is neither calibrated nor given" in verdict([unknown], [unknown]).notes[0]
    )


def test_what_the_parameters_own_uncertainty_leaves_of_an_input_is_not_missing_dynamics():
    """An error in proportion to the load, by a deviation of a parameter: expected, or not."""

    def wrong(seed, is_expected):
        data = record(seed)
        slow = lfilter([0.1], [1.0, -0.9], data.inputs[:, 1])
        noise = 0.02 * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        noise[:, 0] += slow * 0.1
        by_parameter = np.zeros((N, 2, 1))
        by_parameter[:, 0, 0] = slow * 0.1 * is_expected
        return examine(
            data, data.outputs - noise, expected([np.nan, np.nan], data, errors=by_parameter)
        )

    assert "follow load" in " ".join(verdict([wrong(1, 0.0)], [wrong(2, 0.0)]).reasons)
    assert verdict([wrong(1, 1.0)], [wrong(2, 1.0)]).trust == "good"


def let_by_parameters(size):
    """The verdict on a model that errs in validation by what its parameters' uncertainty lets it.

    size: of that error of the speed, in parts of its deviation.
    """

    def examined(seed, part):
        data = record(seed)
        by_parameter = np.zeros((N, 2, 1))
        by_parameter[:, 0, 0] = size * data.inputs[:, 0]
        noise = NOISE * np.random.default_rng([seed, 2]).standard_normal((N, 2))
        wrong = noise + part * by_parameter[:, :, 0]
        floor = expected([NOISE**2, NOISE**2], data, errors=by_parameter)
        return examine(data, data.outputs - wrong, floor)

    return verdict([examined(1, 0.0)], [examined(2, 1.0)])


@pytest.mark.parametrize(
    ("size", "trust", "reason"),
    [
        (0.8, "limited", "speed is explained poorly on the validation data (fit 20 %): what"),
        (0.2, "good", "Data not used in the fit are explained as well as parameters known so"),
    ],
)
def test_an_error_that_vague_parameters_let_a_model_make_is_one_all_the_same(size, trust, reason):
    """It speaks against neither structure nor intervals, but predictions are what they are."""
    given = let_by_parameters(size)
    (says,) = given.predicted.reasons
    assert (given.predicted.trust, given.parameters.trust) == (trust, "good")
    assert says.startswith(reason) and "speed, current down" not in says
    if trust == "good":
        assert "; speed errs 3.9 times as much as in training), current down to the noise" in says


def test_faults_of_the_data_count_where_they_matter():
    def with_fault(severity="doubt", part="training", **kind):
        fault = DataFault(
            "clipped",
            severity,
            part,
            ("log",),
            "speed",
            "Clipped",
            "it bends",
            "",
            0.1,
            **kind,
        )
        return judge(MODEL, [result(1)], [result(2)], told(""), findings=(), faults=[fault])

    assert with_fault("note", moves_parameters=True).trust == "good"
    moved, void = with_fault(moves_parameters=True), with_fault(voids_validation=True)
    (reason,) = moved.parameters.reasons
    assert moved.predicted.trust == "good" and reason.startswith("log: Clipped")
    assert (void.predicted.reasons, void.parameters.trust) == ((reason,), "good")
    # No parameter comes of what was held back.
    apart = with_fault(part="validation")
    assert apart.trust == "good" and apart.notes[0] == reason


def finding(kind, deviations, name="speed"):
    move = Move(estimate("K_m"), 0.1 * deviations, deviations)
    return Finding(kind, name, "s", 2e-3, 1e-6, 0.1, (move,))


def test_what_is_missing_counts_by_how_far_it_moves_parameters():
    def found(findings, alternative=None):
        return judge(
            MODEL,
            [result(1)],
            [result(2)],
            told(""),
            findings=findings,
            alternative=alternative,
        )

    far = found([finding("delay", 2.5)])
    assert (far.predicted.trust, far.parameters.trust) == ("good", "limited")
    assert far.parameters.reasons == (
        "speed is logged 2 ms late (p = 1e-06); with that K_m 1 -> 1.25.",
    )
    both = found([finding("delay", 1.0), finding("offset", 0.8)])
    assert len(both.parameters.reasons) == 2, "together they move it by 1.8 deviations"
    assert found([finding("delay", 1.0), finding("offset", -0.8)]).trust == "good"
    near = found([finding("delay", 0.5)])
    assert near.trust == "good" and "speed is logged 2 ms late" in near.notes[0]
    turned = found([replace(finding("gain", 2.5), amplitude=-2.4)])
    assert turned.parameters.reasons == (
        "speed has the opposite sign of what the model has (p = 1e-06).",
    )
    # A variant counts by what its own fit says.
    variant = finding("variant", 2.5, "friction=stribeck")
    assert found([variant]).trust == "good"
    comparison = Comparison((), "", True, 1, 1.0)
    fits, moved = {"speed": (74.0, 82.0)}, {"K_m": (0.124, 0.14, "V")}
    fitted = Alternative(variant.name, True, fits, moved, comparison, GASSI(MODEL))
    assert found([variant], fitted).parameters.reasons == (
        "The model lacks friction=stribeck; fitted with it: speed 74 -> 82 %, K_m 0.124 -> 0.14 V.",
    )
    assert found([variant], replace(fitted, better=False)).trust == "good"
    # Beside a term that was fitted no other function is said.
    term = AddedTerm("speed", "speed", "sign", 0.1, -1.0, 1.0)
    added = replace(fitted, name="a term", terms=(term,))
    in_vain = found([replace(finding("function", 3.0), term=term)], replace(added, better=False))
    assert in_vain.parameters.reasons == (
        "What is left looks like a term in the sign of speed in dspeed/dt, like dry friction (p = "
        "1e-06), but fitted with it the model explains the data no better: something else is "
        "missing, and parameters may be off by more than their intervals.",
    )
    # Once in a thousand logs something looks like that by chance.
    doubtful = replace(finding("function", 3.0), term=term, p_value=7e-4)
    chance = found([doubtful], replace(added, better=False))
    assert chance.trust == "good"
    assert chance.notes[0].endswith("no better: so it looks at times by chance.")
    assert found([doubtful]).parameters.trust == found([doubtful], added).parameters.trust
    assert found([doubtful]).parameters.trust == "limited"
    # So it is where a function of another shape was fitted in its place.
    shaped = replace(doubtful, term=replace(term, shape="cube"), rivals=(term,))
    assert found([shaped], replace(added, better=False)).trust == "good"
    # What training has better and validation worse is no term of the plant's either.
    validated = replace(
        added,
        better=False,
        fits={"speed": (74.0, 32.0)},
        comparison=replace(comparison, validated=True),
    )
    worse = found([replace(finding("function", 3.0), term=term)], validated)
    assert "the model explains validation worse (speed 74 -> 32 %): " in worse.parameters.reasons[0]
    wild = found(
        [replace(finding("function", 3.0), term=term)],
        replace(validated, fits={"speed": (74.0, -np.inf)}),
    )
    assert "the model cannot be simulated on validation, " in wild.parameters.reasons[0]
    others = [finding("function", 3.0), finding("offset", 2.0)]
    reasons = found(others, added).parameters.reasons
    assert [reason.partition(";")[0] for reason in reasons] == [
        "The model lacks a term",
        "speed is 0.002 s off (p = 1e-06)",
    ]


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
        validation=[wandering(2, 0.6, 0.9, 1.5 * NOISE)], uncertainty=told("bound"), feasible=False
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
    found = verdict([wandering(1, size, pole)], [wandering(2, size, pole)])
    assert found.trust == trust, found.reasons
    if trust == "limited":
        both = found.predicted.reasons + found.parameters.reasons
        assert len(both) == 2
        assert all(" % of speed's variance is left, and wanders" in reason for reason in both)


def nothing_expected(data):
    return expected([np.nan, np.nan], data)


@pytest.mark.parametrize(("size", "trust"), [(0.3, "limited"), (0.1, "good")])
def test_predictions_of_which_much_is_left_beyond_a_known_noise_are_not_good(size, trust):
    def above(seed):
        data = record(seed)
        wrong = size * np.random.default_rng([seed, 2]).standard_normal((N, 2)) * [1.0, 0.1]
        return examine(data, data.outputs - wrong, expected([NOISE**2, NOISE**2], data))

    predicted = verdict([above(1)], [above(2)]).predicted
    assert predicted.trust == trust
    if trust == "limited":
        assert predicted.reasons == ("10 % of speed's variance is left, more than noise explains.",)


@pytest.mark.parametrize(("push", "trust"), [(1.0, "limited"), (0.2, "good")])
def test_an_error_that_two_outputs_share_is_no_sensors(push, trust):
    def pushed(seed, **noise):
        data = record(seed, **noise)
        rng = np.random.default_rng([seed, 4])
        wrong = rng.standard_normal((N, 2)) + push * rng.standard_normal((N, 1))
        return examine(data, data.outputs - NOISE * wrong, nothing_expected(data))

    judged = verdict([pushed(1)], [pushed(2)])
    assert judged.parameters.trust == trust
    if trust == "limited":
        assert "speed and current err together (correlation 0." in judged.parameters.reasons[0]
    # The noise of a measured input comes through the plant to both.
    torque = {"input_noise": np.array([0.0, 0.1])}
    assert verdict([pushed(1, **torque)], [pushed(2, **torque)]).trust == "good"


def test_errors_that_grow_with_the_rate_of_change_are_no_sensors():
    def jittered(seed, jitter, passed_on=0.0):
        data = record(seed)
        smooth = lfilter([0.1], [1.0, -0.9], data.inputs, axis=0)
        rng, rates = np.random.default_rng([seed, 5]), np.gradient(smooth, axis=0)
        errors = NOISE * rng.standard_normal((N, 2))
        errors += jitter * rng.standard_normal((N, 2)) * rates
        data = replace(data, outputs=smooth + errors)
        unknown, by_inputs = [np.nan, np.nan], (passed_on * rates) ** 2
        return examine(data, smooth, expected(unknown, data, passed_on=by_inputs))

    judged = verdict([jittered(1, 1.0)], [jittered(2, 1.0)])
    assert judged.predicted.trust == "good"
    assert judged.parameters.reasons[0].startswith("speed errs more the faster it changes")
    assert verdict([jittered(1, 0.0)], [jittered(2, 0.0)]).trust == "good"
    # Noise of inputs that the plant passes on in fast motion is no fault, unless it is far less.
    passed_on = verdict([jittered(1, 1.0, passed_on=1.0)], [jittered(2, 1.0, passed_on=1.0)])
    assert passed_on.trust == "good"
    more = verdict([jittered(1, 1.0, passed_on=0.2)], [jittered(2, 1.0, passed_on=0.2)])
    assert "speed errs more the faster" in more.parameters.reasons[0]


@pytest.mark.parametrize("outliers", [0.05, 0.0])
def test_errors_far_from_their_neighbours_are_outliers(outliers):
    """Student's noise of four degrees of freedom has none."""

    def spiked(seed):
        data, rng = record(seed), np.random.default_rng([seed, 6])
        wrong = rng.standard_t(4.0, (N, 2))
        wrong[rng.uniform(size=N) < outliers, 0] += 15.0
        return examine(data, data.outputs - NOISE * wrong)

    judged = verdict([spiked(1)], [spiked(2)])
    assert judged.parameters.trust == ("limited" if outliers else "good")
    if outliers:
        (reason,) = judged.parameters.reasons
        assert " % of what is left of speed stands alone, far from what is left" in reason


@pytest.mark.parametrize("step", [0.2, 0.02])
def test_a_sensor_that_rounds_what_moves_slowly_has_no_outliers(step):
    """At rest it errs by the same again and again, and then by a step at once."""

    def rounded(seed):
        data = record(seed)
        levels = np.repeat(np.random.default_rng([seed, 7]).uniform(-1.0, 1.0, (N // 40, 2)), 40, 0)
        slow = lfilter([0.1], [1.0, -0.9], levels, axis=0)
        shown = replace(data, outputs=step * np.round(slow / step))
        return examine(shown, slow)

    assert not any(np.any(rounded(seed).alone) for seed in range(5))


def test_parts_of_a_log_that_want_their_own_parameters_make_them_doubtful():
    apart = replace(told(""), disagreement=9.0)
    (reason,) = verdict(uncertainty=apart).parameters.reasons
    assert reason.startswith("Parts of the log want parameters of their own, 3.0 times")
    assert verdict(uncertainty=replace(apart, disagreement=2.0)).trust == "good"


def test_a_filter_whose_errors_it_could_foresee_makes_parameters_doubtful():
    coloured = replace(told(""), succession=np.array([0.1, -0.45]))
    (reason,) = verdict(uncertainty=coloured).parameters.reasons
    assert reason.startswith("The filter's errors of current follow one another (correlation -0.45")
    assert verdict(uncertainty=replace(coloured, succession=np.array([0.1, 0.2]))).trust == "good"


def test_a_filter_within_whose_noise_equations_bend_makes_parameters_doubtful():
    bent = replace(told(""), bent=np.array([0.01, 0.07]), moved_by_bends=9.0)
    (reason,) = verdict(uncertainty=bent).parameters.reasons
    assert "bend (in 7% of the samples of current)" in reason
    assert verdict(uncertainty=replace(bent, moved_by_bends=1.4)).trust == "good"
