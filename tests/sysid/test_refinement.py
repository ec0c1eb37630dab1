from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sysid import (
    BatchSimulator,
    Constraint,
    Dataset,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting import descent as stalls
from sysid.fitting import refinement
from sysid.fitting.descent import PERTURBATIONS, Descent, Point
from sysid.fitting.objective import FLOORS, Objective
from sysid.fitting.refinement import (
    begin,
    beside,
    corrected,
    errors_of,
    refine,
    refine_each,
)
from tests.sysid.support import MOTOR, Formula, draw, lag, motor, motor_record


def objective(model, records, accuracy=1e-6, **how):
    return Objective(
        BatchSimulator(model, accuracy=accuracy), SearchSpace.of(model), records, **how
    )


# --- the figure that is minimised -----------------------------------------------------------


def test_the_error_is_the_mean_over_outputs_of_the_normalised_rmse():
    records = [motor_record(60), motor_record(90, amplitude=0.02)]
    target = objective(motor(), records)
    vector = motor().nominal * 1.02
    error, _ = target.evaluate(vector[None])
    peak = np.maximum(*[np.abs(r.outputs).max(axis=0) for r in records])
    residual = np.concatenate(
        [(target.simulator.trajectories(vector, r)[0] - r.outputs) / peak for r in records]
    )
    expected = np.mean(np.sqrt(np.mean(residual**2, axis=0)))
    assert error[0] == pytest.approx(expected, rel=1e-3)
    weighted, _ = objective(motor(), records, weights=np.array([3.0, 1.0])).evaluate(vector[None])
    parts = np.sqrt(np.mean(residual**2, axis=0))
    assert weighted[0] == pytest.approx(0.75 * parts[0] + 0.25 * parts[1], rel=1e-3)


def test_the_error_does_not_grow_with_lost_samples():
    record = motor_record(60)
    outputs = record.outputs.copy()
    outputs[1::2] = np.nan
    vector = motor().nominal[None] * 1.02
    full, _ = objective(motor(), [record]).evaluate(vector)
    half, _ = objective(motor(), [Dataset(record.inputs, outputs, record.dt)]).evaluate(vector)
    assert half[0] == pytest.approx(full[0], rel=0.2)


def test_an_output_that_was_never_measured_is_named():
    record = motor_record(60)
    outputs = record.outputs.copy()
    outputs[:, 1] = np.nan
    with pytest.raises(ValueError, match="no record has a measured sample of output 'omega'"):
        objective(motor(), [Dataset(record.inputs, outputs, record.dt)])


# --- Levenberg-Marquardt --------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_it_finds_the_motor_from_nearby(seed):
    target = objective(motor(), [motor_record()])
    start = draw(motor(1.15), np.random.default_rng(seed), 1)[0]
    before, _ = target.evaluate(start[None])
    seen = []
    result = refine(target, start, on_iteration=lambda step: seen.append(step.error))
    assert result.error < 1e-4 * before[0]
    assert len(seen) == result.iterations
    np.testing.assert_allclose(result.chromosome, list(MOTOR.values()), rtol=1e-2)


def test_it_stays_in_range_and_gains_nonetheless():
    model = motor(1.2).with_parameters(resistance={"lower": 1.1, "upper": 1.3, "nominal": 1.2})
    target = objective(model, [motor_record()])
    start = model.nominal * 1.05
    before, _ = target.evaluate(start[None])
    result = refine(target, start)
    space = target.space
    assert np.all(result.chromosome >= space.lower * (1 - 1e-12))
    assert np.all(result.chromosome <= space.upper * (1 + 1e-12))
    assert result.chromosome[0] == pytest.approx(1.1)
    assert result.error < before[0]


def test_at_a_bound_the_others_still_reach_their_minimum():
    """What it ends at beside the bound is what it finds with that parameter fixed there."""
    model = motor(1.3).with_parameters(resistance={"lower": 1.2, "upper": 1.5, "nominal": 1.3})
    record = motor_record()
    target = objective(model, [record])
    bound = refine(target, model.nominal * 1.02, tolerance=1e-9)
    simulator = BatchSimulator(model, accuracy=1e-6)
    rest = Objective(simulator, SearchSpace.of(model, fixed={"resistance": 1.2}), [record])
    fixed = refine(rest, model.nominal[1:], tolerance=1e-9)
    assert bound.chromosome[0] == pytest.approx(1.2)
    assert bound.error == pytest.approx(fixed.error, rel=3e-6)


def test_the_number_of_integration_steps_may_change_on_the_way():
    """A model that gets faster as it improves: steps are chosen anew, and the end is exact."""
    model = lag(
        name="faster",
        parameters=(
            Parameter("rate", "1/s", 300.0, 1.0, 3000.0, "log"),
            Parameter("shift", "1", 0.1, -1.0, 1.0, minimum=-9.0),
        ),
        derivative=faster_derivative,
    )
    inputs = np.sin(np.arange(150) / 4.0)
    blank = Dataset(inputs, np.full(150, np.nan), 0.01)
    exact = BatchSimulator(model, accuracy=1e-8).trajectories(model.nominal, blank)[0]
    target = objective(model, [Dataset(inputs, exact, 0.01)], accuracy=1e-2)
    start = np.array([3.0, 0.3])
    steps = [
        target.simulator.steps_of_each(vector, target.records[0])[0]
        for vector in (start, model.nominal)
    ]
    assert steps[1] > steps[0]
    result = refine(target, start)
    # The simulations differ from the exact record by their accuracy; the end does not.
    assert result.error < 1e-2
    assert result.iterations < 20
    again = refine(target, model.nominal)
    np.testing.assert_allclose(result.chromosome, again.chromosome, rtol=1e-3)


def faster_derivative(x, u, p):
    return (-p[0] * math.tanh(x[0] - u[0] - p[1]),)


def test_it_keeps_the_constraints():
    limit = Constraint("resistance >= 1.05", lambda p: 1.05 - p[0])
    target = objective(motor(1.5, (limit,)), [motor_record()])
    start = motor().nominal * 1.1
    before, _ = target.evaluate(start[None])
    result = refine(target, start)
    assert result.chromosome[0] >= 1.05
    assert result.error < before[0]


def mass_derivative(x, u, p):
    return (p[0] * u[0] + p[1] * u[1] + p[2],)


def test_it_solves_a_linear_problem_as_lstsq_does():
    """y' is linear in the parameters, so y is too; the records' noise leaves a residue."""
    parameters = tuple(Parameter(f"p{i}", "1", 0.0, -5.0, 5.0, minimum=-9.0) for i in range(3))
    model = ProcessModel(
        "mass", (State("v", "m/s"),), (Input("a", "1"), Input("b", "1")), (Output("v", "m/s"),),
        parameters, mass_derivative,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    n, dt = 80, 0.1
    inputs = rng.uniform(-1.0, 1.0, (n, 2))
    columns = np.column_stack([inputs, np.ones(n)])
    design = np.vstack([np.zeros(3), np.cumsum(columns[:-1] * dt, axis=0)])
    outputs = design @ np.array([1.5, -2.0, 0.3]) + rng.normal(0.0, 0.05, n)
    outputs[0] = 0.0
    solution = np.linalg.lstsq(design, outputs, rcond=None)[0]
    target = objective(model, [Dataset(inputs, outputs, dt)])
    result = refine(target, np.array([-3.0, 3.0, -1.0]))
    np.testing.assert_allclose(result.chromosome, solution, atol=1e-4)
    residue = np.sqrt(np.mean((design @ solution - outputs) ** 2)) / np.abs(outputs).max()
    assert result.error == pytest.approx(residue, rel=1e-5)


def test_it_ends_at_the_minimum_of_the_mean_rmse_not_of_the_squares():
    """One sensor reads a tenth too much, so that the outputs disagree about the parameters."""
    clean = motor_record()
    noise = np.random.default_rng(4).normal(0.0, 0.02, clean.outputs.shape)
    outputs = clean.outputs * [1.0, 1.1] + [0.3, 0.0] + noise * np.abs(clean.outputs).max(axis=0)
    target = objective(motor(2.0), [Dataset(clean.inputs, outputs, clean.dt)], 1e-7)
    result = refine(target, motor().nominal, tolerance=1e-13, max_iterations=200)
    shares = np.diag(np.full(5, 1e-2))
    up, _ = target.evaluate(result.chromosome * np.exp(shares))
    down, _ = target.evaluate(result.chromosome * np.exp(-shares))
    # Distance to the vertex of the parabola through three points, in parts of one per cent.
    curvature = up + down - 2.0 * result.error
    inside = (result.chromosome > target.space.lower * 1.02) & (
        result.chromosome < target.space.upper / 1.02
    )
    assert inside.sum() >= 3
    offset = 0.5 * (up - down) / curvature
    assert np.all(np.abs(offset[inside]) < 0.2)


def test_a_chromosome_that_cannot_be_simulated_is_returned_as_it_is():
    record = Dataset(np.ones(300), np.linspace(1.0, 2.0, 300), 0.01)
    parameters = (
        Parameter("gain", "1", 1.0, 0.1, 9.0),
        Parameter("tau", "s", 0.1, -0.01, -0.001, minimum=-1.0),
    )
    target = objective(lag(parameters=parameters), [record], 1e-3)
    result = refine(target, np.array([0.5, -0.001]))
    assert not np.isfinite(result.error)
    assert result.iterations == 0


def test_an_output_that_lost_most_of_its_samples_counts_as_the_error_counts_it():
    """Two outputs that disagree on one gain: the compromise is the minimum of the mean RMSE."""
    rng = np.random.default_rng(6)
    u = rng.standard_normal(400)
    outputs = np.column_stack([1.0 * u, 1.3 * u]) + 0.2 * rng.standard_normal((400, 2))
    outputs[rng.random(400) < 0.9, 1] = np.nan
    model = ProcessModel(
        name="gains",
        states=(State("x", "1"),),
        inputs=(Input("u", "1"),),
        outputs=(Output("good", "1"), Output("patchy", "1")),
        parameters=(Parameter("gain", "1", 1.0, 0.1, 10.0, "log"),),
        derivative=lambda x, u, p: (-x[0],),
        output=lambda x, u, p: (x[0], x[0]),
    )
    simulator = Formula(model, lambda p, u: p["gain"] * np.column_stack([u, u]))
    target = Objective(simulator, SearchSpace.of(model), [Dataset(u, outputs, 0.01)])

    def error(gain):
        return float(target.error_of(target.residuals(np.array([[gain]]), [1]).rms)[0])

    exact = minimize_scalar(error, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-9})
    gain = refine(target, np.array([2.0]), tolerance=1e-12).chromosome[0]
    assert gain == pytest.approx(exact.x, abs=1e-5)


def test_a_valley_that_bends_is_followed_in_long_steps():
    """Rosenbrock's, five times as narrow as his, with noise: straight steps take 75 iterations."""
    rng = np.random.default_rng(0)
    u = np.kron(np.eye(2), np.ones((50, 1)))
    model = lag(
        inputs=(Input("along", "1"), Input("across", "1")),
        parameters=(
            Parameter("a", "1", 1.0, -3.0, 3.0, minimum=-9.0),
            Parameter("b", "1", 1.0, -9.0, 9.0, minimum=-9.0),
        ),
    )
    valley = Formula(
        model,
        lambda p, u: u[:, :1] * p["a"] + 50.0 * u[:, 1:] * (p["b"] - p["a"] ** 2),
    )
    target = Objective(
        valley, SearchSpace.of(model), [Dataset(u, u[:, :1] + rng.normal(0.0, 0.01, (100, 1)), 0.1)]
    )
    end = refine(target, np.array([-1.5, 2.25]), max_iterations=200)
    assert end.iterations <= 30
    a = target.records[0].outputs[:50].mean()
    b = a**2 + target.records[0].outputs[50:].mean() / 50.0
    np.testing.assert_allclose(end.chromosome, [a, b], atol=1e-4)


def test_weights_by_errors_leave_what_is_explained_too_well_smoothed():
    """An output a million times better explained than the other: it decides by neither."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, 100)
    u = SINE[:, None]
    model = lag(
        outputs=(Output("rough", "1"), Output("fine", "1")),
        parameters=(Parameter("gain", "1", 2.0, 0.5, 8.0),),
        derivative=lambda x, u, p: (-x[0],),
        output=lambda x, u, p: (x[0], x[0]),
    )
    outputs = np.column_stack([2.0 * u[:, 0] + noise, 2.0001 * u[:, 0]])
    target = Objective(
        Formula(model, lambda p, u: p["gain"] * np.column_stack([u, u])),
        SearchSpace.of(model),
        [Dataset(u, outputs, 0.01)],
    )
    weighed = target.weighed(np.array([1.0, 100.0]))
    fine = Descent(Point(np.array([2.0001]), 1.0, np.array([1.0, 1e-9])))
    assert stalls.sharpen(target, fine) is not None
    assert stalls.sharpen(weighed, fine) is None
    assert refine(weighed, np.array([1.0])).iterations <= 8


# --- constraints ----------------------------------------------------------------------------


def ordered(p):
    """tau >= 0.03 gain: active where the lag that fits best has a smaller tau."""
    return 0.03 * p[0] - p[1]


@pytest.mark.parametrize("start", [(1.0, 0.0301), (4.0, 0.4), (0.5, 0.05)])
def test_it_slides_along_a_constraint_to_the_best_point_on_it(start):
    rng = np.random.default_rng(0)
    inputs = np.repeat(rng.uniform(-1.0, 1.0, 20), 10)[:, None]
    truth = np.array([[2.0, 0.04]])
    model = lag(constraints=(Constraint("tau >= 0.03 gain", ordered),))
    blank = Dataset(inputs, np.full((200, 1), np.nan), 0.01)
    clean = BatchSimulator(model, accuracy=1e-6).trajectories(truth, blank)[0]
    target = objective(model, [Dataset(inputs, clean, 0.01)])
    # On the boundary the gain is all there is to choose.
    best = minimize_scalar(
        lambda gain: float(target.evaluate(np.array([[gain, 0.03 * gain]]))[0][0]),
        bounds=(1.0, 3.0), method="bounded", options={"xatol": 1e-9},
    )  # fmt: skip
    refined = refine(target, np.array(start))
    assert refined.error == pytest.approx(best.fun, rel=1e-4)
    assert refined.chromosome == pytest.approx([best.x, 0.03 * best.x], rel=1e-3)
    assert not np.any(target.space.violations(refined.chromosome[None]) > 0.0)


# --- where a descent stalls: each strategy in the situation it is for ------------------------


@pytest.fixture
def without(monkeypatch):
    """Refinement as it would be if a strategy were not there."""

    def refine_without(strategy, *problem, **settings):
        with monkeypatch.context() as patch:
            for stall, strategies in stalls.STRATEGIES.items():
                rest = tuple(s for s in strategies if s is not strategy)
                patch.setitem(stalls.STRATEGIES, stall, rest)
            return refine(*problem, **settings)

    return refine_without


def gain_objective(simulator, formula, outputs, **parameter):
    """Objective of one gain whose outputs are a formula of it, at 100 samples of a sine."""
    settings = {"nominal": 1.0, "lower": 0.1, "upper": 10.0, "scale": "log"} | parameter
    model = lag(
        outputs=tuple(Output(f"y{j}", "1") for j in range(len(outputs.T))),
        output=lambda x, u, p: (x[0],) * len(outputs.T),
        parameters=(Parameter("gain", "1", **settings),),
        derivative=lambda x, u, p: (p[0] * u[0],),
    )
    return Objective(
        simulator(model, formula), SearchSpace.of(model), [Dataset(SINE, outputs, 0.01)]
    )


SINE = np.sin(np.arange(100) / 5.0)


class Edge(Formula):
    """Above a gain of 1.5 one step a sample seems to do, and the two it needs fail."""

    def steps_of_each(self, vectors, record):
        return np.where(vectors[:, 0] > 1.5, 2, 1)

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        outputs = super().trajectories(vectors, record, n_steps, starts)
        outputs[(vectors[:, 0] > 1.5) & (n_steps == 2)] = np.nan
        return outputs


def test_it_retreats_from_where_simulations_fail(without):
    target = gain_objective(Edge, lambda p, u: p["gain"] * u, 2.0 * SINE[:, None])
    refined = refine(target, np.array([0.3]))
    assert np.isfinite(refined.error)
    assert 0.3 < refined.chromosome[0] <= 1.5
    # The error is that of the chromosome: half the record's peak is explained at a gain of 1.
    exact = (2.0 - refined.chromosome[0]) / 2.0 * np.sqrt(np.mean(SINE**2)) / np.abs(SINE).max()
    assert refined.error == pytest.approx(exact, rel=1e-6)
    lost = without(stalls.retreat, target, np.array([0.3]))
    assert lost.chromosome[0] > 1.5 and not np.isfinite(lost.rms).all()


class Brink(Formula):
    """One step a sample serves the start and nothing beside it, three serve all.

    With ``unbounded`` nothing serves another gain than the start's.
    """

    unbounded = False

    def steps_of_each(self, vectors, record):
        return np.where(np.all(vectors == START, axis=1), 1, 3)

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        outputs = super().trajectories(vectors, record, n_steps, starts)
        outputs[np.any(vectors != START, axis=1) & (n_steps < 3)] = np.inf
        if self.unbounded:
            outputs[vectors[:, 0] != START[0]] = np.inf
        return outputs


START = np.array([0.3, 2.0])


def brink(unbounded=False):
    model = lag(
        parameters=(
            Parameter("gain", "1", 1.0, 0.1, 10.0, "log"),
            Parameter("offset", "1", 0.0, -10.0, 10.0, minimum=-math.inf),
        ),
        derivative=lambda x, u, p: (p[0] * u[0] + p[1],),
    )
    simulator = Brink(model, lambda p, u: p["gain"] * u + p["offset"])
    simulator.unbounded = unbounded
    return Objective(simulator, SearchSpace.of(model), [Dataset(SINE, 2.0 * SINE, 0.01)])


def test_it_braces_where_the_steps_of_the_descent_fail_beside_it(without):
    refined = refine(brink(), START)
    np.testing.assert_allclose(refined.chromosome, [2.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(without(stalls.brace, brink(), START).chromosome, START)


def test_the_rest_of_the_parameters_go_on_where_one_cannot_be_moved():
    refined = refine(brink(unbounded=True), START)
    assert refined.chromosome[0] == START[0]
    assert refined.chromosome[1] == pytest.approx(np.mean(1.7 * SINE))


def test_a_parameter_moves_on_the_side_where_simulations_run():
    """The root of what is negative beyond the start: forward neighbours all fail."""

    def formula(p, u):
        with np.errstate(invalid="ignore"):
            return np.sqrt(0.3 - p["gain"]) * u

    model = lag(
        parameters=(Parameter("gain", "1", 0.1, 0.0, 1.0),), derivative=lambda x, u, p: (p[0],)
    )
    records = [Dataset(SINE, 0.3 * SINE, 0.01)]
    target = Objective(Formula(model, formula), SearchSpace.of(model), records)
    refined = refine(target, np.array([0.3 - 1e-8]))
    assert refined.chromosome[0] == pytest.approx(0.21, abs=1e-5)


STAIR = 0.02  # a hundredth of the range is more than half of it


def staired(gain):
    """A gain that rises by stairs, each of which falls on its way."""
    rest = np.mod(gain, STAIR)
    return gain - 1.5 * rest


def test_it_coarsens_where_small_perturbations_see_stairs(without):
    target = gain_objective(
        Formula, lambda p, u: staired(p["gain"]) * u, 2.0 * SINE[:, None], lower=1.0, upper=3.0,
        scale="linear",
    )  # fmt: skip
    start = np.array([1.113])
    assert refine(target, start).chromosome[0] == pytest.approx(2.0, abs=2 * STAIR)
    assert without(stalls.coarsen, target, start).chromosome[0] < 1.0 + 10 * STAIR


def test_it_refocuses_after_larger_perturbations(without):
    """Stairs far from the minimum; around it all is smooth, and bent to large perturbations."""

    def formula(p, u):
        far = abs(p["gain"] - 2.0) > 0.5
        return np.exp((staired(p["gain"]) if far else p["gain"]) * u)

    outputs = np.exp(2.0 * SINE) + 3.0 * SINE**2
    target = gain_objective(
        Formula, formula, outputs[:, None], lower=1.0, upper=3.0, scale="linear"
    )

    def error(gain):
        return float(target.evaluate(np.array([[gain]]))[0][0])

    exact = minimize_scalar(error, bounds=(1.6, 2.4), method="bounded", options={"xatol": 1e-10})
    start = np.array([1.113])
    refined = refine(target, start, tolerance=1e-12)
    assert refined.chromosome[0] == pytest.approx(exact.x, abs=1e-6)
    biased = without(stalls.refocus, target, start, tolerance=1e-12)
    assert 2e-5 < abs(biased.chromosome[0] - exact.x) < 0.1


def test_it_sharpens_the_crease_of_an_output_that_is_explained_exactly(without):
    """One output wants a gain of 2, and little of it; a noisy one wants 3."""
    noise = np.random.default_rng(1).normal(0.0, 0.3, 100)
    outputs = np.column_stack([2.0 * SINE, 3.0 * SINE + noise])
    target = gain_objective(Formula, lambda p, u: p["gain"] * np.column_stack([u, u]), outputs)
    start = np.array([1.0])
    assert refine(target, start).chromosome[0] == pytest.approx(2.0, abs=1e-3)
    assert without(stalls.sharpen, target, start).chromosome[0] > 2.01


class Sluggish(Formula):
    """From a gain of 1.9 on three steps a sample are needed; fewer are wrong by a hundredth."""

    def steps_of_each(self, vectors, record):
        return np.where(vectors[:, 0] > 1.9, 3, 1)

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        outputs = super().trajectories(vectors, record, n_steps, starts)
        outputs[n_steps < 3] *= 1.01
        return outputs


def test_it_resolves_what_needs_more_steps_than_where_it_came_from(without):
    outputs = 2.0 * SINE + 0.01 * np.random.default_rng(0).normal(size=100)
    target = gain_objective(Sluggish, lambda p, u: p["gain"] * u, outputs[:, None])
    exact, start = SINE @ outputs / (SINE @ SINE), np.array([1.8])
    assert refine(target, start).chromosome[0] == pytest.approx(exact, rel=1e-6)
    coarse = without(stalls.resolve, target, start)
    assert coarse.chromosome[0] == pytest.approx(exact / 1.01, rel=1e-6)


def test_a_descent_by_coarse_simulations_ends_where_exact_ones_would(without):
    outputs = 2.0 * SINE + 0.01 * np.random.default_rng(0).normal(size=100)
    exact, start = SINE @ outputs / (SINE @ SINE), np.array([1.0])
    target, rough = (
        gain_objective(Formula, by_gain, outputs[:, None])
        for by_gain in (
            lambda p, u: p["gain"] * u,
            lambda p, u: (1.01 * p["gain"] + 0.01 * p["gain"] ** 2) * u,
        )
    )
    assert abs(refine(rough, start).chromosome[0] / exact - 1.0) > 0.02
    corrected = target.with_slopes_by(rough.simulator)
    end = refine(corrected, start)
    assert end.chromosome[0] == pytest.approx(exact, rel=5e-4)
    assert end.error == pytest.approx(target.evaluate(end.chromosome[None])[0][0], rel=1e-3)
    once = without(stalls.correct, corrected, start)
    assert abs(once.chromosome[0] / exact - 1.0) > 5e-4


def test_a_descent_with_the_corrections_of_another_ends_where_its_own_would(monkeypatch):
    """It begins without simulations by finer steps: those of the other are still near."""
    outputs = 2.0 * SINE + 0.01 * np.random.default_rng(0).normal(size=100)
    target, rough = (
        gain_objective(Formula, by_gain, outputs[:, None])
        for by_gain in (lambda p, u: p["gain"] * u, lambda p, u: 1.01 * p["gain"] * u)
    )
    by_both, start = target.with_slopes_by(rough.simulator), np.array([1.9])
    other = corrected(by_both, np.array([1.95]))
    assert corrected(target, np.array([2.0])) is None  # nothing to correct
    far, near = (begin(by_both, np.array([gain])) for gain in (0.01, 1.9))
    assert beside(by_both.space, far, other) is far
    lent, own = beside(by_both.space, near, other), refine(by_both, start)
    finer = []
    simulate = type(target.simulator).residuals

    def counted(simulator, vectors, *others, **options):
        if simulator is target.simulator:
            finer.append(len(vectors))
        return simulate(simulator, vectors, *others, **options)

    monkeypatch.setattr(type(target.simulator), "residuals", counted)
    by_lent = errors_of(by_both, [lent])
    assert not finer
    assert by_lent == pytest.approx(errors_of(by_both, [near]), rel=0.02)
    finer.clear()
    (end,) = refine_each(by_both, [lent])
    assert len(finer) == 1  # where it ends
    assert end.chromosome[0] == pytest.approx(own.chromosome[0], rel=1e-4)
    assert end.error == pytest.approx(target.evaluate(end.chromosome[None])[0][0], rel=1e-3)


def test_a_descent_that_crawls_far_from_its_goal_is_given_up(monkeypatch):
    crawling = Descent(Point(np.zeros(1), 0.5), crawling=5, goal=0.4)
    assert crawling.is_given_up
    for other in ({"crawling": 4}, {"goal": 0.6}, {"goal": np.inf}):
        assert not replace(crawling, **other).is_given_up
    # A valley in which by these measures every iteration crawls.
    monkeypatch.setattr("sysid.fitting.refinement._CRAWL", 1e9)
    bent = gain_objective(Formula, lambda p, u: p["gain"] ** 9 * u, 2.0 * SINE[:, None] + 0.01)
    end, cut = (
        refine_each(bent, [replace(begin(bent, np.array([0.2])), goal=goal)])[0]
        for goal in (np.inf, 0.0)
    )
    assert cut.iterations == 5 < end.iterations


def test_a_descent_too_slow_for_its_goal_ends_and_one_on_a_plateau_does_not():
    # For the first seven iterations it gains next to nothing, and after ten nothing.
    bell = gain_objective(
        Formula,
        lambda p, u: 2.0 * np.exp(-((p["gain"] - 3.0) ** 2)) * u,
        2.0 * SINE[:, None] + 0.01,
    )
    free, coming, hopeless = (
        refine_each(bell, [begin(bell, np.array([0.2]), tolerance=1e-12)], 40, goal=goal)[0]
        for goal in (np.inf, 0.02, 1e-3)
    )
    assert coming.error == free.error < 0.01
    assert hopeless.iterations < coming.iterations
    assert hopeless.error == pytest.approx(free.error, rel=1e-2)


class InTwoSteps(Formula):
    def steps_of_each(self, vectors, record):
        return np.full(len(vectors), 2)


def test_a_descent_that_is_cut_short_tells_the_steps_that_its_error_is_by():
    target, rough = (
        gain_objective(kind, lambda p, u: p["gain"] * u, 2.0 * SINE[:, None] + 0.01)
        for kind in (InTwoSteps, Formula)
    )
    cut = refine(target.with_slopes_by(rough.simulator), np.array([1.0]), max_iterations=1)
    assert cut.chromosome[0] > 1.5
    assert cut.steps == (2,)


HERE = Point(np.array([math.log(1.8)]), 0.1, np.array([0.1]))


@pytest.mark.parametrize(
    ("strategy", "state"),
    [
        (stalls.retreat, {}),
        (stalls.brace, {"steps": (1,), "steps_at": HERE.at, "braced": 3}),
        (stalls.coarsen, {"level": len(PERTURBATIONS) - 1}),
        (stalls.sharpen, {}),
        (stalls.sharpen, {"point": Point(HERE.at, 0.1, np.zeros(1)), "smoothing": 2}),
        (stalls.resolve, {"steps": (1,), "steps_at": HERE.at + 1e-3}),
        (stalls.resolve, {"steps": (3,), "steps_at": HERE.at + 1.0}),
        (stalls.correct, {}),
        (stalls.correct, {"shift": stalls.Shift(HERE.at, (2,), (1,), np.zeros((100, 1)))}),
        (stalls.refocus, {"level": 0, "error_of_round": 1.0}),
        (stalls.refocus, {"level": 2, "error_of_round": 0.10001}),
    ],
)
def test_every_strategy_gives_up_once(strategy, state):
    assert len(FLOORS) == 3
    target = gain_objective(Sluggish, lambda p, u: p["gain"] * u, 2.0 * SINE[:, None])
    assert strategy(target, Descent(**({"point": HERE} | state))) is None


def test_a_descent_ends_on_its_safe_point_when_patience_does():
    safe = Point(np.zeros(1), 0.2)
    descent = Descent(HERE, safe, failures=stalls.PATIENCE - 2)
    once = stalls.retreat(None, descent)
    assert once.point is safe and not once.finished and once.damping > descent.damping
    assert stalls.retreat(None, once).finished


def test_in_threads_descents_go_the_same_way(monkeypatch):
    """What takes long is done by several of them, each descent's by one."""
    record, simulator = motor_record(), BatchSimulator(motor(), threads=2)
    objective = Objective(simulator, SearchSpace.of(motor()), [record])
    rng = np.random.default_rng(8)
    starts = draw(motor(), rng, 5)[:, objective.space.index]
    tasks = []

    def ends(long):
        monkeypatch.setattr(refinement, "_LONG", long)
        return refine_each(objective, [begin(objective, start) for start in starts], 6)

    alone = ends(np.inf)
    kept = simulator.workers.results
    monkeypatch.setattr(
        simulator.workers, "results", lambda f, each: tasks.append(len(each)) or kept(f, each)
    )
    for one, other in zip(alone, ends(0), strict=True):
        np.testing.assert_array_equal(one.chromosome, other.chromosome)
        assert (one.error, one.iterations) == (other.error, other.iterations)
    assert max(tasks) == len(starts)
