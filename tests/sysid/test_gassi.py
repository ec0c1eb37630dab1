from __future__ import annotations

import math

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from sysid import (
    GASSI,
    Constraint,
    Dataset,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
    examples,
)
from sysid.engine.simulation import BatchSimulator
from sysid.judging.examination import verdict_of
from tests.soak import mostly_soak
from tests.sysid.support import INFEASIBLE, MOTOR, lag, motor, motor_record

TRUE = np.array(list(MOTOR.values()))
VALIDATION = {"period": 0.5, "duty": 0.4, "frequency": 0.4, "amplitude": 0.02}


def quick(**settings):
    return GASSI(motor(), **({"population": 40, "generations": 6} | settings))


# --- identification of the DC motor ---------------------------------------------------------


def test_the_thesis_preset_recovers_the_motor_from_ten_per_cent_around():
    model = motor().with_parameters(
        **{name: {"lower": 0.9 * v, "upper": 1.1 * v} for name, v in MOTOR.items()}
    )
    errors = []
    for seed in range(5):
        found = GASSI(
            model, preset="thesis", population=400, generations=50, elite_percent=1.0,
            random_state=seed,
        ).fit(motor_record())  # fmt: skip
        errors.append(found.error_)
        assert found.n_simulations_ == 400 * 50
        assert found.feasible_
    assert np.median(errors) <= 5e-5


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_default_preset_recovers_the_motor_from_a_decade_around(seed):
    found = GASSI(motor(), random_state=seed).fit(motor_record())
    assert found.error_ < 2.67e-5
    assert found.error_ <= found.search_error_
    np.testing.assert_allclose(found.vector_, TRUE, rtol=0.02)
    validation = motor_record(**VALIDATION)
    assert found.score(validation) > 0.999


def test_several_records_of_any_length_and_rate():
    records = [motor_record(120), motor_record(150, 0.005, **VALIDATION)]
    found = GASSI(motor(2.0), population=100, generations=10).fit(records)
    np.testing.assert_allclose(found.vector_, TRUE, rtol=0.02)


# --- one seed, one result -------------------------------------------------------------------


@pytest.mark.parametrize("preset", mostly_soak(["default", "thesis", "cega", "classic"], 2))
def test_one_seed_gives_one_result_whatever_the_threads(preset):
    fits = [
        quick(preset=preset, random_state=3, threads=threads).fit(motor_record())
        for threads in (1, 1, 2, 3)
    ]
    for other in fits[1:]:
        np.testing.assert_array_equal(other.vector_, fits[0].vector_)
        np.testing.assert_array_equal(other.history_, fits[0].history_)
        assert other.error_ == fits[0].error_
    another = quick(preset=preset, random_state=4).fit(motor_record())
    assert not np.array_equal(another.history_, fits[0].history_)


# --- settings -------------------------------------------------------------------------------


def test_ranges_and_fixed_values_are_kept():
    found = quick(
        ranges={"resistance": (1.05, 1.2)}, fixed={"damping": 2e-5}
    ).fit(motor_record())  # fmt: skip
    assert 1.05 * (1 - 1e-12) <= found.parameters_["resistance"] <= 1.2 * (1 + 1e-12)
    assert found.parameters_["damping"] == 2e-5
    assert found.space_.names == ("resistance", "inductance", "inertia", "constant")
    assert found.chromosome_.shape == (4,)
    np.testing.assert_array_equal(found.vector_, list(found.parameters_.values()))


@pytest.mark.soak
def test_a_search_passes_an_open_end_but_not_a_given_one():
    for given, expected in (
        ((2.0, None), 2.0),  # the truth is below
        ((0.4, 0.7), 0.7),  # and above
        ((None, 0.3), 0.3),
    ):
        found = quick(ranges={"resistance": given}).fit(motor_record())
        assert found.parameters_["resistance"] == pytest.approx(expected, rel=1e-6)
        assert found.space_.on_bound(found.chromosome_).tolist()[0]
    # 0.05 .. 0.5 is only where this one starts.
    model = motor().with_parameters(resistance={"lower": 0.05, "upper": 0.5, "nominal": 0.1})
    found = quick(population=100, generations=20, ranges={"resistance": (0.02, None)})
    found.set_params(model=model).fit(motor_record())
    assert found.parameters_["resistance"] == pytest.approx(1.0, rel=0.02)
    assert not found.space_.on_bound(found.chromosome_).any()


def test_tied_parameters_stay_tied_and_a_scale_is_taken():
    true = MOTOR["damping"] / MOTOR["inertia"]
    found = quick(
        population=100, generations=10, tied={"damping": f"{true} * inertia"},
        scale={"resistance": "linear"},
    ).fit(motor_record())  # fmt: skip
    assert found.space_.names == ("resistance", "inductance", "inertia", "constant")
    assert found.space_.log.tolist() == [False, True, True, True]
    np.testing.assert_allclose(found.vector_, TRUE, rtol=0.02)
    assert found.parameters_["damping"] == pytest.approx(true * found.parameters_["inertia"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tied": {"damping": "inertai"}}, "no parameter 'inertai'"),
        ({"ranges": {"speed": (0.0, 1.0)}}, "no parameter 'speed'"),
        ({"ranges": {"resistance": (2.0, 1.0)}}, "low end"),
        ({"ranges": {"resistance": (-2.0, 1.0)}}, "physically possible"),
        ({"fixed": {"resistance": -2.0}}, "physical limits"),
        ({"fixed": dict(MOTOR)}, "every parameter is fixed"),
        ({"weights": {"speed": 1.0}}, "weight for unknown output 'speed'.*current, omega"),
        ({"weights": {"omega": -1.0}}, "weight of omega is -1.0"),
        ({"weights": {"omega": 0.0, "current": 0.0}}, "every output has weight 0"),
        ({"preset": "best"}, "unknown preset 'best'; choose from classic, cega, thesis, default"),
        ({"population": 1}, "population is 1"),
        ({"model": None}, "needs a process model"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    with pytest.raises(ModelError, match=message):
        quick().set_params(**settings).fit(motor_record())


def test_a_weight_of_zero_ignores_an_output():
    record = motor_record()
    spoiled = Dataset(record.inputs, record.outputs * [1.0, np.nan], record.dt)
    spoiled.outputs[:, 1] = np.random.default_rng(0).normal(size=200)
    found = quick(population=100, generations=10, weights={"omega": 0.0}).fit(spoiled)
    assert found.error_ < 0.02


def test_when_every_simulation_fails_it_says_so():
    explosive = lag(
        parameters=(
            Parameter("gain", "1", 1.0, 0.5, 2.0),
            Parameter("tau", "s", -1e-3, -1e-3, -5e-4, minimum=-1.0),
        )
    )
    record = Dataset(np.ones(300), np.linspace(3.0, 4.0, 300), 0.01)
    with pytest.raises(ModelError, match=r"every simulation of the first generation failed.*20"):
        GASSI(explosive, population=20, generations=3).fit(record)


def test_failures_are_counted():
    model = lag(
        parameters=(
            Parameter("gain", "1", 1.0, 0.5, 2.0),
            Parameter("tau", "s", 0.1, -1e-2, 1.0, minimum=-1.0),
        )
    )
    record = Dataset(np.ones(300), np.linspace(3.0, 1.0, 300), 0.05)
    found = GASSI(model, population=200, generations=2, preset="thesis").fit(record)
    assert sum(found.flagged_.values()) > 0
    assert set(found.flagged_) <= {"unbounded", "over_budget"}


@pytest.mark.soak
def test_what_is_far_stiffer_than_most_is_found_though_the_search_passes_over_it():
    """It takes 362 steps a sample, the middle of the ranges 4: beyond 64 none is simulated."""
    model = lag(
        parameters=(Parameter("dry", "1", 2.0, 0.02, 200.0, "log"),),
        derivative=lambda x, u, p: (u[0] - p[0] * math.tanh(1e3 * x[0]) - 5.0 * x[0],),
    )
    rng, truth = np.random.default_rng(0), np.array([[110.0]])
    inputs = np.repeat(rng.uniform(-150.0, 150.0, 20), 10)
    blank = Dataset(inputs, np.zeros(200), 0.01)
    exact = BatchSimulator(model, accuracy=1e-6, max_steps=8192).trajectories(truth, blank)[0]
    noisy = exact + 0.01 * np.abs(exact).max() * rng.standard_normal(exact.shape)
    record = Dataset(inputs, noisy, 0.01)
    assert BatchSimulator(model).steps_of_each(truth, record) > 300
    found = GASSI(model, population=60, generations=12).fit(record)
    assert found.flagged_["over_budget"] > 0
    assert found.parameters_["dry"] == pytest.approx(110.0, rel=0.01)


def test_infeasible_answers_are_said_to_be():
    found = quick(preset="cega").set_params(model=motor(constraints=(INFEASIBLE,)))
    assert not found.fit(motor_record()).feasible_
    found = quick().set_params(model=motor(constraints=(INFEASIBLE,))).fit(motor_record())
    assert not found.feasible_


def test_the_constraint_holds_in_the_answer():
    limit = Constraint("resistance >= 1.05", lambda p: 1.05 - p[0])
    found = quick().set_params(model=motor(2.0, (limit,))).fit(motor_record())
    assert found.feasible_
    assert found.parameters_["resistance"] >= 1.05


# --- progress and interruption --------------------------------------------------------------


def test_progress_tells_every_generation():
    seen = []
    found = quick(preset="thesis").fit(motor_record(), on_progress=seen.append)
    assert [(p.stage, p.done, p.total) for p in seen] == [("search", i, 6) for i in range(1, 7)]
    assert [p.error for p in seen] == found.history_.tolist()
    assert found.stopped_ == "generations"


class Stop:
    """Interrupts when a stage has come so far."""

    def __init__(self, stage, done):
        self.stage, self.done = stage, done

    def __call__(self, progress):
        if (progress.stage, progress.done) == (self.stage, self.done):
            raise KeyboardInterrupt


def test_an_interrupt_keeps_the_best_so_far():
    whole = quick(preset="thesis").fit(motor_record())
    found = quick(preset="thesis").fit(motor_record(), on_progress=Stop("search", 3))
    assert found.stopped_ == "interrupted"
    np.testing.assert_array_equal(found.history_, whole.history_[:3])
    assert found.error_ == found.search_error_ == whole.history_[2]
    assert found.predict(motor_record()).shape == (200, 2)


def test_an_interrupt_of_a_second_fit_does_not_keep_the_first_answer():
    found = quick().fit(motor_record())
    first = found.vector_
    found.set_params(random_state=9, preset="thesis")
    found.fit(motor_record(), on_progress=Stop("search", 1))
    assert not np.array_equal(found.vector_, first)
    assert found.error_ == found.search_error_ == found.history_[-1]


def test_an_interrupt_while_refining_keeps_what_was_gained():
    found = quick().fit(motor_record(), on_progress=Stop("refine", 3))
    assert found.stopped_ == "interrupted"
    assert len(found.history_) == 3
    assert found.history_[-1] == found.error_ < found.search_error_ == found.history_[0]


def test_the_score_of_several_records_is_the_mean_of_theirs():
    found = quick().fit(motor_record())
    one, other = motor_record(), motor_record(80)
    expected = np.mean([found.score(one), found.score(other)])
    assert found.score([one, other]) == pytest.approx(expected)


def test_convergence_ends_the_search():
    found = quick(preset="thesis", generations=30, termination_ratio=0.9).fit(motor_record())
    assert found.stopped_ == "converged"
    assert len(found.history_) < 30


# --- as scikit-learn expects ----------------------------------------------------------------


def test_parameters_are_stored_as_given_and_cloned():
    found = quick(preset="thesis", fixed={"damping": 2e-5})
    settings = found.get_params()
    assert settings["preset"] == "thesis"
    assert settings["fixed"] == {"damping": 2e-5}
    copy = clone(found)
    assert copy is not found
    assert copy.get_params() == settings
    assert GASSI().get_params()["model"] is None
    found.fit(motor_record())
    assert found.get_params() == settings
    assert not hasattr(clone(found), "vector_")


def test_an_unfitted_one_cannot_predict():
    with pytest.raises(NotFittedError):
        quick().predict(motor_record())


@pytest.mark.soak
def test_arrays_serve_as_well_as_records():
    record = motor_record()
    a = quick().fit(record)
    b = quick(dt=record.dt).fit(record.inputs, record.outputs)
    np.testing.assert_array_equal(a.vector_, b.vector_)
    assert a.score(record) == b.score(record.inputs, record.outputs)
    np.testing.assert_allclose(a.predict(record), b.predict(record.inputs), rtol=1e-6, atol=1e-9)
    with pytest.raises(ModelError, match="dt="):
        quick().fit(record.inputs, record.outputs)
    with pytest.raises(ModelError, match="give Datasets, or the outputs as y"):
        quick().fit(record.inputs)


def test_score_is_the_mean_fit():
    record = motor_record()
    found = quick().fit(record)
    y = found.predict(record)
    spread = np.linalg.norm(record.outputs - record.outputs.mean(axis=0), axis=0)
    expected = np.mean(1.0 - np.linalg.norm(y - record.outputs, axis=0) / spread)
    assert found.score(record) == pytest.approx(expected)


def test_fit_returns_itself():
    found = quick()
    assert found.fit(motor_record()) is found


@pytest.mark.soak
def test_a_free_motion_has_no_inputs():
    """y = exp(-a t) cos(w t), from an unknown speed at the start."""
    model = ProcessModel(
        name="swing",
        states=(State("y", "1"), State("v", "1/s", initial_range=(-2.0, 2.0))),
        inputs=(),
        outputs=(Output("y", "1"),),
        parameters=(
            Parameter("k", "1/s^2", 20.0, 1.0, 500.0, "log"),
            Parameter("c", "1/s", 2.0, 0.1, 10.0, "log"),
        ),
        derivative=lambda x, u, p: (x[1], -p[0] * x[0] - p[1] * x[1]),
    )
    t, decay, frequency = 0.01 * np.arange(400), 0.5, 8.0
    y = np.exp(-decay * t) * np.cos(frequency * t)
    record = Dataset(np.empty((400, 0)), y, 0.01)
    found = GASSI(model, population=40, generations=10).fit(record)
    assert found.parameters_["c"] == pytest.approx(2.0 * decay, rel=1e-6)
    assert found.parameters_["k"] == pytest.approx(frequency**2 + decay**2, rel=1e-6)
    assert found.n_features_in_ == 0
    np.testing.assert_allclose(found.predict(record)[:, 0], y, atol=1e-5)


def test_a_fit_that_ends_where_nothing_can_be_simulated_has_no_intervals():
    """With the steps that the end of a search takes a stiff model may grow beyond all bounds."""
    record = examples.lag_record(seed=0)
    fitted = GASSI(examples.lag(), population=20, generations=2).fit(record)
    fitted.error_ = np.inf
    with pytest.raises(ModelError, match="cannot be simulated where the fit ended"):
        fitted.uncertainty(record)
    reasons = verdict_of(fitted, [record], [examples.lag_record(seed=1)]).parameters.reasons
    assert "The parameters have no intervals" in reasons[0]
