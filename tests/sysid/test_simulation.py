from __future__ import annotations

import math
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from scipy.signal import cont2discrete

from sim_rig.actuator import actuator
from sysid import (
    BatchSimulator,
    Dataset,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
    Status,
)
from tests.soak import mostly_soak
from tests.sysid.reference import simulate as reference
from tests.sysid.support import (
    MOTOR,
    blank,
    draw,
    lag,
    linear_response,
    motor,
    motor_inputs,
    motor_matrices,
    motor_record,
    prbs,
)

DT = 1.0 / 800.0


def parameters_of(count):
    return tuple(Parameter(f"p{i}", "1", 1.0, -9.0, 9.0, minimum=-99.0) for i in range(count))


# --- closed forms ---------------------------------------------------------------------------


def test_a_held_input_gives_the_exponential():
    model, dt, n = lag("zoh"), 0.02, 30
    inputs = np.zeros(n)
    inputs[3:] = 1.0
    gain, tau = 3.0, 0.07
    y = BatchSimulator(model, accuracy=1e-9).trajectories(
        np.array([gain, tau]), blank(model, inputs, dt)
    )[0, :, 0]
    # Row 3 is latched before the step that is applied from row 3 on.
    exact = gain * (1.0 - np.exp(-np.maximum(np.arange(n) - 3, 0) * dt / tau))
    np.testing.assert_allclose(y, exact, atol=1e-7 * gain)
    assert y[3] == 0.0


def test_an_interpolated_input_gives_the_ramp_response():
    model, dt, n = lag("foh"), 0.02, 30
    t = np.arange(n) * dt
    gain, tau = 3.0, 0.07
    y = BatchSimulator(model, accuracy=1e-9).trajectories(
        np.array([gain, tau]), blank(model, t, dt)
    )[0, :, 0]
    np.testing.assert_allclose(y, gain * (t - tau + tau * np.exp(-t / tau)), atol=1e-9)


def test_a_run_starts_from_the_first_measured_sample():
    model = lag()
    y = BatchSimulator(model, accuracy=1e-9).trajectories(
        np.array([1.0, 0.1]), blank(model, np.zeros(20), 0.01, y=4.0)
    )[0, :, 0]
    np.testing.assert_allclose(y, 4.0 * np.exp(-np.arange(20) * 0.01 / 0.1), rtol=1e-7)


@pytest.mark.parametrize("n", [2, 3, 4, 40])
def test_a_spline_input_follows_scipy_through_all_samples(n):
    model = lag("spline", inputs=(Input("u", "1", "spline"),))
    rng = np.random.default_rng(n)
    record = blank(model, rng.normal(size=(n, 1)), 0.3)
    found = BatchSimulator(model, accuracy=1e-8).trajectories(model.nominal, record)[0]
    exact = reference(model, model.nominal, record)
    np.testing.assert_allclose(found, exact, atol=1e-6 * np.abs(exact).max())


def test_a_spline_keeps_a_sine_of_five_samples_a_period():
    """Linear interpolation takes away an eighth of it."""
    dt, omega, n = 0.1, 2.0 * np.pi / 0.5, 400
    inputs = np.sin(omega * dt * np.arange(n))
    swings = {}
    for hold in ("foh", "spline"):
        model = lag(hold)
        gain, tau = model.nominal
        record = blank(model, inputs[:, None], dt)
        late = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, record)[0, 100:, 0]
        swings[hold] = np.sqrt(2.0) * late.std() * np.hypot(1.0, omega * tau) / gain
    assert swings["spline"] == pytest.approx(1.0, abs=0.02)
    assert swings["foh"] == pytest.approx(np.sinc(0.2) ** 2, abs=0.02)


def oscillator_derivative(x, u, p):
    return x[1], -p[0] * p[0] * x[0]


@pytest.mark.soak
def test_an_oscillator_keeps_amplitude_and_phase():
    model = ProcessModel(
        name="oscillator",
        states=(State("x", "m", 1.0), State("v", "m/s")),
        inputs=(),
        outputs=(Output("x", "m"), Output("v", "m/s")),
        parameters=(Parameter("omega", "rad/s", 10.0, 1.0, 100.0, "log"),),
        derivative=oscillator_derivative,
    )
    record = Dataset(np.zeros((200, 0)), np.full((200, 2), np.nan), 0.01)
    omegas = np.array([[3.0], [10.0], [40.0]])
    found = BatchSimulator(model, accuracy=1e-9).trajectories(omegas, record)
    exact = np.cos(omegas * record.time)
    np.testing.assert_allclose(found[:, :, 0], exact, atol=1e-5)
    energy = (omegas * found[:, :, 0]) ** 2 + found[:, :, 1] ** 2
    np.testing.assert_allclose(energy, np.broadcast_to(omegas**2, energy.shape), rtol=1e-5)


def linear_derivative(x, u, p):
    return (
        p[0] * x[0] + p[1] * x[1] + p[2] * x[2] + p[9] * u[0] + p[10] * u[1],
        p[3] * x[0] + p[4] * x[1] + p[5] * x[2] + p[11] * u[0] + p[12] * u[1],
        p[6] * x[0] + p[7] * x[1] + p[8] * x[2] + p[13] * u[0] + p[14] * u[1],
    )


def linear_model(hold):
    return ProcessModel(
        name=f"linear_{hold}",
        states=tuple(State(f"x{i}", "1") for i in range(3)),
        inputs=tuple(Input(f"u{i}", "1", hold) for i in range(2)),
        outputs=(Output("x2", "1"), Output("x0", "1"), Output("x1", "1")),
        parameters=parameters_of(15),
        derivative=linear_derivative,
    )


@pytest.mark.parametrize("hold", mostly_soak(["zoh", "foh"]))
def test_linear_systems_follow_their_exact_discretisation(hold):
    rng = np.random.default_rng(3)
    model, dt, n = linear_model(hold), 0.05, 60
    simulator = BatchSimulator(model, accuracy=1e-9)
    for _ in range(4):
        a = rng.normal(size=(3, 3)) - 2.0 * np.eye(3)
        b = rng.normal(size=(3, 2))
        inputs = np.column_stack([prbs(rng, n, -1, 1, 5), prbs(rng, n, -1, 1, 3)])
        exact = linear_response(a, b, inputs, dt, hold)
        if hold == "zoh":
            ad, bd, *_ = cont2discrete((a, b, np.eye(3), np.zeros((3, 2))), dt, "zoh")
            x = np.zeros((n, 3))
            for k in range(n - 1):
                x[k + 1] = ad @ x[k] + bd @ inputs[k]
            np.testing.assert_allclose(exact, x, atol=1e-12)
        found = simulator.trajectories(
            np.concatenate([a.ravel(), b.ravel()]), blank(model, inputs, dt)
        )[0]
        np.testing.assert_allclose(found, exact[:, [2, 0, 1]], atol=1e-7)


# --- against SciPy --------------------------------------------------------------------------


@pytest.mark.soak
def test_the_actuator_follows_scipy_over_its_shipped_ranges():
    """Each with the steps that the search gives it, at the default accuracy."""
    rng = np.random.default_rng(20)
    model, dt, n = actuator(), 1.0 / 800.0, 40
    worst = 0.0
    simulator = BatchSimulator(model)
    for vector in draw(model, rng, 12):
        inputs = np.column_stack(
            [prbs(rng, n, -4, 4), prbs(rng, n, 0, 0.38), prbs(rng, n, -0.1, 0.1, 5)]
        )
        exact = reference(model, vector, blank(model, inputs, dt))
        scale = np.max(np.abs(exact), axis=0)
        result = simulator.errors(vector, [Dataset(inputs, exact, dt)], [scale])
        assert result.status[0] == Status.OK
        worst = max(worst, np.sqrt(result.sse[0, 0] / n).max())
    assert worst < 1e-3


@pytest.mark.soak
@pytest.mark.parametrize("accuracy", [1e-2, 1e-3, 1e-5])
def test_accuracy_is_held_on_the_dc_motor(accuracy):
    rng = np.random.default_rng(21)
    model, dt = motor(), 0.01
    inputs = motor_inputs()
    simulator = BatchSimulator(model, accuracy=accuracy, max_steps=4096)
    vectors = np.vstack([model.nominal, draw(motor(factor=2.0), rng, 12)])
    for vector in vectors:
        exact = linear_response(*motor_matrices(vector), inputs, dt, "foh")
        scale = np.max(np.abs(exact), axis=0)
        result = simulator.errors(vector, [Dataset(inputs, exact, dt)], [scale])
        assert np.sqrt(result.sse[0, 0] / len(inputs)).max() < accuracy


def test_finer_accuracy_takes_more_steps():
    rng, n = np.random.default_rng(8), 200
    inputs = np.column_stack([prbs(rng, n, -1, 1), prbs(rng, n, 0, 0.14), np.zeros(n)])
    record = blank(actuator(), inputs, 1.0 / 800.0)
    needed = [
        BatchSimulator(actuator(), accuracy=a).steps_of_each(actuator().nominal, record)[0]
        for a in (1e-1, 1e-3, 1e-5, 1e-7)
    ]
    assert needed == sorted(needed)
    assert needed[0] < needed[-1]


# --- sums of squares ------------------------------------------------------------------------


def noisy_record(n=150, seed=5):
    rng = np.random.default_rng(seed)
    clean = motor_record(n)
    return Dataset(clean.inputs, clean.outputs + rng.normal(0.0, 0.1, (n, 2)), clean.dt)


def test_sse_is_the_sum_of_squared_scaled_residuals():
    simulator = BatchSimulator(motor(), accuracy=1e-6)
    record, scale = noisy_record(), np.array([0.3, 7.0])
    for vector in draw(motor(1.3), np.random.default_rng(6), 3):
        simulated = simulator.trajectories(vector, record)[0]
        expected = np.sum(((simulated - record.outputs) / scale) ** 2, axis=0)
        found = simulator.errors(vector, [record], [scale]).sse[0, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_lost_samples_do_not_count():
    simulator = BatchSimulator(motor(), accuracy=1e-6)
    record = noisy_record()
    lost = record.outputs.copy()
    lost[40:60] = np.nan
    lost[80, 1] = np.nan
    gaps = Dataset(record.inputs, lost, record.dt)
    vectors = draw(motor(1.3), np.random.default_rng(7), 3)
    simulated = simulator.trajectories(vectors, record)
    np.testing.assert_array_equal(simulator.trajectories(vectors, gaps), simulated)
    expected = np.nansum((simulated - lost) ** 2, axis=1)
    np.testing.assert_allclose(simulator.errors(vectors, [gaps]).sse[:, 0], expected, rtol=1e-4)
    assert np.all(expected < np.sum((simulated - record.outputs) ** 2, axis=1))


def test_records_of_different_length_and_rate_are_kept_apart():
    simulator = BatchSimulator(motor())
    records = [noisy_record(), motor_record(90, 0.02), motor_record(2, 0.001)]
    scales = [np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0, 6.0])]
    vectors = draw(motor(3.0), np.random.default_rng(8), 5)
    together = simulator.errors(vectors, records, scales)
    assert together.sse.shape == (5, 3, 2)
    steps = np.zeros(5)
    for r, (record, scale) in enumerate(zip(records, scales, strict=True)):
        alone = simulator.errors(vectors, [record], [scale])
        np.testing.assert_array_equal(together.sse[:, r], alone.sse[:, 0])
        steps += alone.steps
    np.testing.assert_array_equal(together.steps, steps)


# --- the same bits --------------------------------------------------------------------------


def test_where_other_records_start_changes_nothing():
    model, rng = motor(), np.random.default_rng(0)
    parameters = draw(motor(1.3), rng, 2)[[0, 0, 0, 1, 0]]
    records = [motor_record(100), motor_record(90)]
    starts = [rng.standard_normal((5, len(model.states))) for _ in records]
    starts[0][[1, 2, 4]], starts[1][[2, 4]] = starts[0][0], starts[1][0]
    scales, steps = [np.ones(len(model.outputs))] * 2, np.array([[4, 8]] * 4 + [[6, 8]])
    simulator = BatchSimulator(model)
    together = simulator.residuals(parameters, records, scales, steps, starts)
    for row in range(5):
        alone = simulator.residuals(
            parameters[[row]], records, scales, steps[[row]], [start[[row]] for start in starts]
        )
        assert np.array_equal(together.values[..., row], alone.values[..., 0])
        assert np.array_equal(together.sse[row], alone.sse[0])
        assert np.array_equal(together.excess[row], alone.excess[0])


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_bit(threads):
    vectors = draw(motor(), np.random.default_rng(9), 70)
    records = [noisy_record(), motor_record(100, 0.02)]
    one = BatchSimulator(motor(), threads=1)
    more = BatchSimulator(motor(), threads=threads)
    np.testing.assert_array_equal(
        one.errors(vectors, records).sse, more.errors(vectors, records).sse
    )
    np.testing.assert_array_equal(
        one.trajectories(vectors[:20], records[0], 8),
        more.trajectories(vectors[:20], records[0], 8),
    )


def test_a_chromosome_does_not_depend_on_its_population():
    rng = np.random.default_rng(10)
    simulator, record = BatchSimulator(motor()), noisy_record()
    vectors = draw(motor(), rng, 50)
    whole = simulator.errors(vectors, [record])
    for size in (1, 2, 16, 17, 33):
        chosen = rng.permutation(50)[:size]
        part = simulator.errors(vectors[chosen], [record])
        np.testing.assert_array_equal(part.sse, whole.sse[chosen])
        np.testing.assert_array_equal(part.status, whole.status[chosen])
        np.testing.assert_array_equal(part.steps, whole.steps[chosen])


@pytest.mark.parametrize("threads", [1, 3])
def test_steps_that_a_record_asks_for_do_not_depend_on_the_population(threads):
    rng, n = np.random.default_rng(13), 300
    model = actuator()
    inputs = np.column_stack([prbs(rng, n, -1, 1), prbs(rng, n, 0, 0.14), np.zeros(n)])
    outputs = BatchSimulator(model).trajectories(model.nominal, blank(model, inputs, DT))[0]
    record, vectors = Dataset(inputs, outputs, DT), draw(model, rng, 40)
    whole = BatchSimulator(model, threads=2).errors(vectors, [record])
    assert len(np.unique(whole.steps)) > 3
    for size in (1, 16, 23):
        chosen = rng.permutation(40)[:size]
        part = BatchSimulator(model, threads=threads).errors(vectors[chosen], [record])
        np.testing.assert_array_equal(part.sse, whole.sse[chosen])
        np.testing.assert_array_equal(part.status, whole.status[chosen])
        np.testing.assert_array_equal(part.steps, whole.steps[chosen])


SAME_BITS = """
import numpy as np
from sysid import BatchSimulator
from tests.sysid.support import draw, motor, motor_record
vectors = draw(motor(), np.random.default_rng(11), 20)
print(BatchSimulator(motor()).errors(vectors, [motor_record(80)]).sse.tobytes().hex())
"""


def test_another_process_gets_the_same_bits():
    vectors = draw(motor(), np.random.default_rng(11), 20)
    here = BatchSimulator(motor()).errors(vectors, [motor_record(80)]).sse.tobytes().hex()
    there = subprocess.run(
        [sys.executable, "-c", SAME_BITS],
        capture_output=True, text=True, check=True, env=os.environ, cwd=os.curdir,
    ).stdout.strip()  # fmt: skip
    assert there == here


def test_memory_does_not_grow_with_samples_times_chromosomes():
    n, samples = 2000, 5000  # 80 MB if trajectories were kept
    simulator, inputs = BatchSimulator(lag(), threads=1), np.ones((samples, 1))
    record = Dataset(inputs, np.zeros((samples, 1)), 0.01)
    simulator.errors(lag().nominal, [record])
    vectors = draw(lag(), np.random.default_rng(14), n)
    tracemalloc.start()
    simulator.errors(vectors, [record])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e6


# --- failures -------------------------------------------------------------------------------


def test_an_unbounded_chromosome_is_flagged_and_disturbs_no_other():
    model = lag()
    record = Dataset(np.ones(300), np.linspace(1.0, 2.0, 300), 0.01)
    good = np.array([[2.0, 0.05], [1.0, 0.02], [3.0, 0.1]])
    mixed = np.insert(good, 1, [0.5, -0.001], axis=0)  # grows as exp(1000 t)
    simulator = BatchSimulator(model)
    result = simulator.errors(mixed, [record])
    assert result.status.tolist() == [Status.OK, Status.UNBOUNDED, Status.OK, Status.OK]
    assert np.isinf(result.sse[1]).all()
    np.testing.assert_array_equal(
        np.delete(result.sse, 1, axis=0), simulator.errors(good, [record]).sse
    )
    trajectory = simulator.trajectories(mixed, record)
    assert not np.isfinite(trajectory[1]).all()
    assert np.isfinite(np.delete(trajectory, 1, axis=0)).all()


def test_a_failure_on_one_record_is_a_failure_of_the_chromosome():
    short = Dataset(np.ones(10), np.ones(10), 0.01)
    long = Dataset(np.ones(300), np.ones(300), 0.01)
    vectors = np.array([[1.0, 0.05], [0.5, -0.001]])
    result = BatchSimulator(lag()).errors(vectors, [short, long])
    assert result.status.tolist() == [Status.OK, Status.UNBOUNDED]
    assert np.isinf(result.sse[1]).all()


def stiff_derivative(x, u, p):
    return (-p[0] * math.tanh(x[0] - u[0]),)


def stiff_model():
    return lag(
        name="stiff",
        parameters=(Parameter("rate", "1/s", 1.0, 0.1, 1e9, "log"),),
        derivative=stiff_derivative,
    )


def test_a_chromosome_beyond_the_budget_is_flagged_and_disturbs_no_other():
    record = Dataset(np.sin(np.arange(100) / 5.0), np.zeros(100), 0.01)
    vectors = np.array([[1.0], [1e9], [10.0]])
    simulator = BatchSimulator(stiff_model(), max_steps=64)
    result = simulator.errors(vectors, [record])
    assert result.status.tolist() == [Status.OK, Status.OVER_BUDGET, Status.OK]
    assert np.isinf(result.sse[1]).all()
    np.testing.assert_array_equal(
        result.sse[[0, 2]], simulator.errors(vectors[[0, 2]], [record]).sse
    )


def test_parameters_that_are_not_a_number_fail_alone():
    vectors = np.array([[1.0, 0.05], [np.nan, 0.05], [1.0, np.nan], [1.0, 0.0]])
    result = BatchSimulator(lag()).errors(vectors, [Dataset(np.ones(30), np.ones(30), 0.01)])
    assert result.status[0] == Status.OK
    assert np.all(result.status[1:] != Status.OK)


def cliff_derivative(x, u, p):
    return (p[0] * x[0] - p[1] * math.tanh(1000.0 * x[0]),)


@pytest.mark.soak
def test_how_a_chromosome_fails_does_not_depend_on_its_population():
    """Far from zero it is slow and blows up; near zero, where it never is, it would be stiff."""
    model = lag(
        name="cliff",
        parameters=(
            Parameter("a", "1/s", 1.0, -9.0, 9.0, minimum=-1e9),
            Parameter("b", "1/s", 1.0, 0.0, 9.0),
        ),
        derivative=cliff_derivative,
    )
    outputs = np.full(300, np.nan)
    outputs[0] = 5.0
    outputs[100:] = 0.0
    record = Dataset(np.zeros(300), outputs, 0.01)
    vectors = np.array([[1000.0, 100.0], [-1000.0, 0.0]])
    simulator = BatchSimulator(model)
    pair = simulator.errors(vectors, [record])
    alone = simulator.errors(vectors[:1], [record])
    assert pair.status.tolist() == [Status.UNBOUNDED, Status.OK]
    assert alone.status.tolist() == [Status.UNBOUNDED]
    assert alone.steps[0] == pair.steps[0]


def test_settings_out_of_range():
    with pytest.raises(ModelError, match="accuracy"):
        BatchSimulator(lag(), accuracy=1.0)
    with pytest.raises(ModelError, match="threads is 0"):
        BatchSimulator(lag(), threads=0)
    simulator = BatchSimulator(lag())
    with pytest.raises(ModelError, match="no record"):
        simulator.errors(np.ones((1, 2)), [])
    with pytest.raises(ModelError, match=r"expected \(n, 2\)"):
        simulator.errors(np.ones((1, 3)), [Dataset(np.ones(5), np.ones(5), 0.1)])
    with pytest.raises(ModelError, match="2 inputs and 2 outputs"):
        simulator.errors(np.ones((1, 2)), [motor_record(5)])


def test_motor_matrices_and_the_model_agree():
    """The closed form that the other tests lean on, against the equations."""
    rng = np.random.default_rng(12)
    p = np.array(list(MOTOR.values()))
    a, b = motor_matrices(p)
    for _ in range(5):
        x, u = rng.normal(size=2), rng.normal(size=2)
        np.testing.assert_allclose(motor().derivative(x, u, p), a @ x + b @ u, rtol=1e-12)
