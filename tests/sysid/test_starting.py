from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sysid import (
    GASSI,
    BatchSimulator,
    Dataset,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.free_run import estimate_start, free_run
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi.likelihood import fit_likelihood
from sysid.uncertainty import uncertainty


def chain(hidden_range=(-5.0, 5.0)):
    """A hidden first-order lag that drives a measured one."""

    def derivative(x, u, p):
        hidden, seen = x
        slow, fast = p
        return slow * (u[0] - hidden), fast * (hidden - seen)

    return ProcessModel(
        name="chain",
        states=(State("hidden", "1", 0.0, initial_range=hidden_range), State("seen", "1")),
        inputs=(Input("push", "1"),),
        outputs=(Output("seen", "1"),),
        parameters=(
            Parameter("slow", "1/s", 1.0, 0.2, 5.0, "log"),
            Parameter("fast", "1/s", 10.0, 2.0, 50.0, "log"),
        ),
        derivative=derivative,
    )


def record(start, seed, n=200, noise=0.0):
    """The chain's response from a hidden start, by its closed form in matrices."""
    from scipy.linalg import expm

    rng = np.random.default_rng(seed)
    push = np.repeat(rng.uniform(-1, 1, n // 10), 10)
    slow, fast, dt = 1.7, 12.0, 0.01
    whole = expm(dt * np.array([[-slow, 0, slow], [fast, -fast, 0], [0, 0, 0]]))
    x, seen = np.array([start, 0.0]), []
    for u in push:
        seen.append(x[1])
        x = (whole @ [*x, u])[:2]
    return Dataset(push[:, None], np.array(seen)[:, None] + noise * rng.normal(size=(n, 1)), dt)


def test_a_hidden_start_is_found_for_every_record():
    starts = (2.0, -3.0, 0.5)
    records = [record(start, seed, 200 + 50 * seed) for seed, start in enumerate(starts)]
    found = GASSI(chain(), population=24, generations=6).fit(records)
    assert found.parameters_ == pytest.approx({"slow": 1.7, "fast": 12.0}, rel=1e-4)
    for states, start in zip(found.initial_states_, starts, strict=True):
        assert states == {"hidden": pytest.approx(start, abs=1e-3)}
    assert found.error_ < 1e-5


def test_without_a_range_the_start_stays_as_declared():
    found = GASSI(chain(None), population=24, generations=6).fit(record(2.0, 0))
    assert found.initial_states_ == []
    assert found.error_ > 1e-2


def test_a_prediction_finds_the_start_of_its_own_record():
    found = GASSI(chain(), population=24, generations=6, dt=record(0.0, 0).dt).fit(record(2.0, 0))
    other = record(-4.0, 7)
    np.testing.assert_allclose(found.predict(other), other.outputs, atol=1e-3)
    # An array has no outputs to tell the start from.
    from_rest = record(0.0, 7)
    np.testing.assert_allclose(found.predict(other.inputs), from_rest.outputs, atol=1e-3)


def test_the_start_is_the_least_squares_one():
    model, noisy = chain(), record(2.0, 3, noise=0.05)
    vector = np.array([1.7, 12.0])
    simulator = BatchSimulator(model, accuracy=1e-6)
    found = estimate_start(simulator, vector, noisy)[0]
    # The output is affine in the start: two simulations give the least-squares one.
    both = np.array([[0.0, noisy.outputs[0, 0]], [1.0, noisy.outputs[0, 0]]])
    base, moved = simulator.trajectories(np.stack([vector, vector]), noisy, None, both)[:, :, 0]
    slope, rest = moved - base, noisy.outputs[:, 0] - base
    assert found == pytest.approx(float(slope @ rest / (slope @ slope)), abs=1e-4)


def test_of_a_long_record_the_beginning_tells_the_start():
    long = record(2.0, 3, n=10_000)
    later = long.outputs.copy()
    later[9000:] += 5.0
    disturbed = replace(long, outputs=later)
    found = estimate_start(BatchSimulator(chain()), np.array([1.7, 12.0]), disturbed)
    assert found[0] == pytest.approx(2.0, abs=1e-3)


def test_a_start_outside_its_range_ends_on_it():
    found = estimate_start(
        BatchSimulator(chain((-1.0, 1.0))), np.array([1.7, 12.0]), record(3.0, 1)
    )
    assert found[0] == pytest.approx(1.0)


def test_outputs_never_measured_leave_the_declared_start():
    blank = Dataset(np.zeros((20, 1)), np.full((20, 1), np.nan), 0.01)
    np.testing.assert_array_equal(
        estimate_start(BatchSimulator(chain()), np.array([1.7, 12.0]), blank), [0.0, 0.0]
    )


def test_starts_belong_to_their_records():
    model = chain()
    space = SearchSpace.of(model).with_starts([record(0.0, 0), record(0.0, 1)])
    assert space.names == ("slow", "fast", "hidden(0) 1", "hidden(0) 2")
    rows = np.array([[1.0, 10.0, 3.0, 4.0], [2.0, 20.0, 5.0, 6.0]])
    own = np.array([0.5, 0.25])
    np.testing.assert_array_equal(space.full(rows), rows[:, :2])
    np.testing.assert_array_equal(space.starts(rows, 0, own), [[3.0, 0.25], [5.0, 0.25]])
    np.testing.assert_array_equal(space.starts(rows, 1, own), [[4.0, 0.25], [6.0, 0.25]])
    assert space.named_starts(rows[1]) == [{"hidden": 5.0}, {"hidden": 6.0}]
    assert SearchSpace.of(chain(None)).with_starts([record(0.0, 0)]).names == ("slow", "fast")


def test_each_chromosome_starts_where_it_says():
    """One batch with different starts is the same as one simulation after another."""
    model, data = chain(), record(2.0, 0)
    simulator = BatchSimulator(model)
    rng = np.random.default_rng(1)
    vectors = rng.uniform([0.5, 5.0], [3.0, 30.0], (37, 2))
    starts = rng.normal(size=(37, 2))
    together = simulator.errors(vectors, [data], None, [starts]).sse
    for i in (0, 15, 16, 36):
        alone = simulator.errors(vectors[i : i + 1], [data], None, [starts[i : i + 1]]).sse
        np.testing.assert_array_equal(together[i], alone[0])
    outputs = simulator.trajectories(vectors, data, 2, starts)
    np.testing.assert_array_equal(outputs[:, 0, 0], starts[:, 1])


def test_the_refinement_moves_parameters_and_starts_together():
    model, data = chain(), record(2.0, 0)
    space = SearchSpace.of(model).with_starts([data])
    objective = Objective(BatchSimulator(model, accuracy=1e-6), space, [data])
    found = refine(objective, np.array([1.0, 10.0, 0.0]))
    np.testing.assert_allclose(found.chromosome, [1.7, 12.0, 2.0], rtol=1e-4)


def test_a_range_of_starts_that_is_no_range_is_refused():
    with pytest.raises(ModelError, match=r"hidden\(0\).*\[low, high\]"):
        replace(chain().states[0], initial_range=(1.0, 1.0))


# --- where states start, as told ---------------------------------------------------------------


def test_a_told_value_goes_before_the_first_sample():
    data = record(2.0, 0)
    shifted = Dataset(data.inputs, data.outputs + 0.3, data.dt)
    model = chain().with_initial({"seen": 0.1, "hidden": 0.7})
    np.testing.assert_array_equal(shifted.initial_state(model), [0.7, 0.1])
    assert SearchSpace.of(model).with_starts([shifted]).names == ("slow", "fast")
    again = model.with_initial({"seen": "first"})
    np.testing.assert_array_equal(shifted.initial_state(again), [0.7, 0.3])
    np.testing.assert_array_equal(shifted.initial_state(chain()), [0.0, 0.3])


def test_a_noisy_first_sample_is_estimated_around():
    """The first sample is far off; the truth is within the output's span."""
    data = record(0.0, 3, noise=0.002)
    data.outputs[0] += 0.15
    model = chain(None).with_initial({"seen": "estimate"})
    space = SearchSpace.of(model).with_starts([data, data])
    assert space.names == ("slow", "fast", "seen(0) 1", "seen(0) 2")
    span = float(np.ptp(data.outputs))
    first = data.outputs[0, 0]
    assert space.lower[2:] == pytest.approx([first - span] * 2)
    assert space.upper[2:] == pytest.approx([first + span] * 2)
    np.testing.assert_allclose(space.with_nominal_starts(np.ones(2)), [1.0, 1.0, first, first])
    found = GASSI(model, population=24, generations=6).fit(data)
    # The wrong sample is one of the dozen that tell the start.
    assert found.initial_states_ == [{"seen": pytest.approx(0.0, abs=0.05)}]
    plain = GASSI(chain(None), population=24, generations=6).fit(data)
    assert plain.error_ > found.error_
    # A prediction follows the same rule on its own record.
    np.testing.assert_allclose(found.predict(data)[0], 0.0, atol=0.05)
    np.testing.assert_allclose(plain.predict(data)[0], first)


def test_a_told_range_bounds_the_estimate():
    model = chain().with_initial({"hidden": (-1.0, 1.0)})
    found = estimate_start(BatchSimulator(model), np.array([1.7, 12.0]), record(3.0, 1))
    assert found[0] == pytest.approx(1.0)
    whole = chain((-5.0, 5.0)).with_initial({"hidden": "estimate"})
    assert whole.states[0].initial_range == (-5.0, 5.0)


def test_the_span_of_a_still_or_unmeasured_output():
    model = chain(None).with_initial({"seen": "estimate"})
    still = Dataset(np.zeros(4), np.full(4, 3.0), 0.1)
    assert still.initial_range(model, 1) == (2.0, 4.0)
    blank = Dataset(np.zeros(4), np.full(4, np.nan), 0.1)
    assert blank.initial_range(model, 1) == (-1.0, 1.0)
    assert still.initial_range(model, 0) is None


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ({"hiden": 1.0}, "no state 'hiden'; it has hidden, seen"),
        ({"hidden": "first"}, "hidden of model chain is no output.*'estimate' or \\[low, high\\]"),
        ({"hidden": "estimate"}, "no range of its own.*\\[low, high\\]"),
        ({"hidden": (1.0, 0.0)}, r"hidden\(0\): range"),
        ({"hidden": (0.0, np.inf)}, "not finite"),
        ({"hidden": np.nan}, "nan is no start"),
        ({"hidden": "last"}, "'last' is no start"),
    ],
)
def test_starts_that_make_no_sense(starts, message):
    with pytest.raises(ModelError, match=message):
        chain(None).with_initial(starts)


# --- what is hardly damped: a pendulum with dry friction that swings freely ---------------------

SWING = np.array([0.02, 0.6, 0.002, 0.008])  # of which only the ratios act


def pendulum():
    def derivative(x, u, p):
        angle, speed = x
        inertia, weight, viscous, dry = p
        friction = viscous * speed + dry * max(-1.0, min(1.0, speed / 1e-3))
        return speed, (-weight * math.sin(angle) - friction) / inertia

    return ProcessModel(
        name="pendulum",
        states=(
            State("angle", "rad", initial_range=(-3.0, 3.0)),
            State("speed", "rad/s", initial_range=(-1.0, 1.0)),
        ),
        inputs=(),
        outputs=(Output("angle", "rad"),),
        parameters=tuple(
            Parameter(name, unit, value, value / 10.0, value * 10.0, "log")
            for name, unit, value in zip(
                ("inertia", "weight", "viscous", "dry"),
                ("kg*m^2", "N*m", "N*m*s/rad", "N*m"),
                SWING,
                strict=True,
            )
        ),
        derivative=derivative,
    )


@pytest.fixture(scope="module")
def swinging():
    """720 samples over ten periods by SciPy, without and with noise."""
    from scipy.integrate import solve_ivp

    model = pendulum()
    t = np.arange(720) / 60.0
    truth = solve_ivp(
        lambda _, x: model.derivative(tuple(x), (), tuple(SWING)), (0.0, t[-1]), [1.2, 0.0],
        t_eval=t, rtol=1e-8, atol=1e-9, max_step=2e-3,
    ).y[0]  # fmt: skip
    noise = np.random.default_rng(0).normal(0.0, 0.005, len(t))
    records = [Dataset(np.zeros((len(t), 0)), y[:, None], 1 / 60) for y in (truth, truth + noise)]
    return model, *records


@pytest.mark.soak
def test_errors_of_single_steps_do_not_add_up_beyond_the_accuracy(swinging):
    model, exact, _ = swinging
    outputs = free_run(BatchSimulator(model), SWING, exact)
    assert np.sqrt(np.mean((outputs - exact.outputs) ** 2)) < 1e-3 * 1.2


def test_errors_of_the_steps_do_not_show_in_what_a_run_leaves(swinging):
    """An encoder resolves an angle far better than a search simulates to."""
    model, exact, _ = swinging
    noise = 5e-5 * np.random.default_rng(1).standard_normal(exact.outputs.shape)
    record = replace(exact, outputs=exact.outputs + noise)
    left = free_run(BatchSimulator(model), SWING, record) - record.outputs
    assert np.sqrt(np.mean(left**2)) < 1.1 * np.sqrt(np.mean(noise**2))


@pytest.mark.soak
def test_what_acts_only_together_is_told_where_slopes_are_jagged(swinging):
    model, _, noisy = swinging
    space = SearchSpace.of(model).with_starts([noisy])
    objective = Objective(BatchSimulator(model), space, [noisy])
    result = fit_likelihood(objective, [np.array([*SWING * 1.3, 1.2, 0.0])])
    optimum = result.optimum
    intervals = uncertainty(optimum.objective, optimum.chromosome, result.rivals)
    (ambiguity,) = intervals.ambiguities
    assert ambiguity.kind == "tied"
    assert set(ambiguity.parameters) == {"inertia", "weight", "viscous", "dry"}
    assert len(ambiguity.determined) == 3 and len(ambiguity.measure) == 1
    truth = dict(zip(model.parameter_names, SWING.tolist(), strict=True))
    for estimate in ambiguity.determined:
        # Twice the interval: of one record that is fixed.
        assert abs(estimate.at(truth) - estimate.value) < estimate.high - estimate.low
