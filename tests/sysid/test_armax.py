from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from sysid import ARMAX, ARX, Dataset, ModelError
from sysid.linear.prediction_error import EquationFit, fit_equation
from tests.sysid.linear_systems import (
    OFFSET,
    SIGMA,
    A,
    B,
    C,
    forecast,
    identity,
    record,
    recursion,
    telegraph,
)

NC = (2, 1)


def siso(seed, n=300, c=(0.8,), sigma=0.5, spread=1.0):
    """y(t) = 0.7 y(t-1) + u(t-1) + 0.3 + C e, one of each; returns arrays u (n, 1), y (n,)."""
    rng = np.random.default_rng(seed)
    u = telegraph(rng, n, 1)
    noise = lfilter([1.0, *c], [1.0], sigma * rng.normal(size=n))
    y = lfilter([1.0], [1.0, -0.7], np.concatenate(([0.0], u[:-1, 0])) + 0.3 + noise)
    return u, y


def equation_errors(theta, u, y):
    """C(q) e of y(t) + a y(t-1) = b u(t-1) + offset + C(q) e, all rows but the first."""
    return y[1:] + theta[0] * y[:-1] - theta[1] * u[:-1, 0] - theta[2]


def determinant_and_squares(noise, c):
    """Of C(q) e = noise, by its covariance matrix: log det, and the squares of e with its past."""
    n, full = len(noise), np.concatenate(([1.0], c))
    bands = np.zeros((len(full), n))
    for lag in range(len(full)):
        bands[lag, : n - lag if lag < n else 0] = full[lag:] @ full[: len(full) - lag]
    factor = cholesky_banded(bands, lower=True)
    squares = noise @ cho_solve_banded((factor, True), noise)
    return 2.0 * np.log(factor[0]).sum(), squares


def likelihood(c, *runs):
    """Logarithm of the likelihood of runs of noise C(q) e, for the best variance of e."""
    n = sum(len(noise) for noise in runs)
    log_dets, squares = np.transpose([determinant_and_squares(noise, c) for noise in runs])
    return -0.5 * (n * (np.log(2.0 * np.pi * squares.sum() / n) + 1.0) + log_dets.sum())


def most_likely(start, runs, scale):
    """A general solver's best theta for runs (u, y), and its likelihood."""

    def cost(scaled):
        theta = scaled * scale
        if abs(theta[3]) >= 0.999:
            return np.inf
        return -likelihood(theta[3:], *(equation_errors(theta, *run) for run in runs))

    best = minimize(cost, start / scale, method="Nelder-Mead", options={"maxfev": 2000})
    return best.x * scale, -best.fun


# --- known systems --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_estimates_lie_within_a_few_standard_errors(seed):
    found = ARMAX(2, 2, NC).fit(record(2000, seed, 1.0))
    assert found.converged_
    for value, error, truth in [
        (found.A_[1:], found.A_std_[1:], A[1:]),
        (found.B_[1:], found.B_std_[1:], B[1:]),
        (found.offset_, found.offset_std_, OFFSET),
        (found.C_[1:, 0], found.C_std_[1:, 0], C[1:, 0]),
        (found.C_[1, 1], found.C_std_[1, 1], C[1, 1]),
    ]:
        assert np.abs((value - truth) / error).max() < 4.0
    assert found.C_[2, 1] == found.C_std_[2, 1] == 0.0
    assert_array_equal(found.C_[0], 1.0)
    assert_allclose(found.noise_covariance_ / np.outer(SIGMA, SIGMA), np.eye(2), atol=0.12)


def test_a_system_without_noise_is_found_exactly():
    found = ARMAX(2, 2, 2).fit(record())
    assert_allclose(found.A_, A, rtol=1e-8, atol=1e-9)
    assert_allclose(found.B_, B, rtol=1e-8, atol=1e-7)
    # There is no noise to tell the colour of.
    assert_array_equal(found.C_[1:], 0.0)
    assert_allclose(found.score(record(seed=1)), 1.0)


@pytest.mark.soak
def test_intervals_cover_what_they_claim():
    truth = np.array([-0.7, 1.0, 0.3, 0.5])
    hits = []
    for seed in range(250):
        found = ARMAX(1, 1, 1).fit(*siso(seed, c=(0.5,)))
        spread = np.sqrt(np.diag(found.covariance_))
        hits.append(np.abs(found.theta_ - truth) < 1.96 * spread)
    inside = np.mean(hits, axis=0)
    assert np.all(inside > 0.91)
    assert np.all(inside < 0.985)
    assert 0.93 < inside.mean() < 0.97


@pytest.mark.soak
def test_coloured_noise_biases_arx_but_not_armax():
    arx = np.array([ARX(1, 1).fit(*siso(seed, sigma=1.0)).theta_[0] for seed in range(100)])
    armax = np.array([ARMAX(1, 1, 1).fit(*siso(seed, sigma=1.0)).theta_[0] for seed in range(100)])
    error = armax.std(ddof=1) / 10.0
    assert abs(arx.mean() + 0.7) > 20.0 * error
    assert abs(armax.mean() + 0.7) < 4.0 * error + 1.0 / 300


def test_measurement_noise_is_the_case_of_c_equal_to_a():
    rng = np.random.default_rng(0)
    u = telegraph(rng, 3000, 1)
    clean = lfilter([0.0, 1.0, 0.5], [1.0, -1.7, 0.8], u[:, 0])
    y = clean + 0.3 * clean.std() * rng.normal(size=3000)
    found = ARMAX(2, 2, 2).fit(u, y)
    assert_allclose(found.C_[:, 0], found.A_[:, 0, 0], atol=0.05)
    assert_allclose(found.A_[:, 0, 0], [1.0, -1.7, 0.8], atol=0.01)
    arx = ARX(2, 2).fit(u, y)
    fresh = Dataset(u[:500], clean[:500], 1.0)
    assert found.score(fresh) > 0.97
    assert arx.score(fresh) < 0.7


def test_noise_with_a_root_outside_has_a_twin_with_the_root_inside():
    u, y = siso(3, 4000, c=(2.0,))
    found = ARMAX(1, 1, 1).fit(u, y)
    assert found.C_[1, 0] == pytest.approx(0.5, abs=0.05)
    assert found.noise_covariance_[0, 0] == pytest.approx(4.0 * 0.25, rel=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_strongly_coloured_noise_is_not_taken_for_a_local_minimum(seed):
    # From C = 1 half of these end in a local minimum with twice the loss.
    u, y = siso(seed, 400, c=(1.9, 0.95), sigma=1.0)
    found = ARMAX(1, 1, 2).fit(u, y)
    best = ARMAX(1, 1, 2).fit(*siso(seed, 4000, c=(1.9, 0.95), sigma=1.0))
    assert found.loss_[0] == pytest.approx(1.0, abs=0.25)
    assert_allclose(best.C_[1:, 0], [1.9, 0.95], atol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_a_minimum_on_the_rim_of_stability_is_reached(seed):
    # Undamped steps run away from it.
    e = np.random.default_rng(seed).normal(size=200)
    y = lfilter([1.0, -1.6, 0.9], [1.0], e)
    found = ARMAX(1, 0, 3, offset=False).fit(np.zeros((200, 1)), y)
    assert found.converged_
    assert found.loss_[0] == pytest.approx(np.mean(e**2), rel=0.06)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_the_search_only_goes_downhill(seed):
    # Taking every step, it never settles in this narrow valley.
    found = ARMAX(1, 1, 4).fit(*siso(seed, 400, c=(-2.1, 2.4, -1.8, 0.55), sigma=1.0))
    assert found.converged_
    assert found.iterations_[0] < 40


@pytest.mark.parametrize("seed", range(8))
def test_every_c_is_stable(seed):
    u, y = siso(seed, 120, c=(-1.0,))
    found = ARMAX(1, 1, 3).fit(u, y)
    assert np.abs(np.roots(found.C_[:, 0])).max() <= 0.999 + 1e-9
    assert np.all(np.isfinite(found.theta_))


def test_noise_alone_as_a_moving_average():
    e = np.random.default_rng(0).normal(size=6000)
    y = 5.0 + lfilter([1.0, -0.6], [1.0], e)
    found = ARMAX(0, 0, 1).fit(np.zeros((6000, 1)), y)
    r0, r1 = np.var(y), np.cov(y[1:], y[:-1])[0, 1]
    # The moments' estimate: r1 / r0 = c / (1 + c^2).
    rho = r1 / r0
    assert found.C_[1, 0] == pytest.approx((1 - np.sqrt(1 - 4 * rho**2)) / (2 * rho), abs=0.04)
    assert found.C_std_[1, 0] == pytest.approx(np.sqrt((1 - 0.36) / 6000), rel=0.1)
    assert found.offset_[0] == pytest.approx(5.0, abs=4 * 0.4 / np.sqrt(6000))


# --- the minimum ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_most_likely_model_that_a_general_solver_finds(seed):
    truth = np.array([-0.7, 1.0, 0.3, 0.9 * (-1) ** seed])
    u, y = siso(seed, 150, c=truth[3:])
    found = ARMAX(1, 1, 1).fit(u, y)
    spread = np.sqrt(np.diag(found.covariance_))
    theta, value = most_likely(truth, [(u, y)], spread)
    own = likelihood(found.theta_[3:], equation_errors(found.theta_, u, y))
    assert found.log_likelihood_ == pytest.approx(own, rel=1e-9)
    assert found.log_likelihood_ == pytest.approx(value, abs=1e-3)
    # Gauss and Newton alone take up to thirty: they overestimate the curvature near the rim.
    assert found.iterations_[0] <= 6
    assert_allclose(found.theta_ / spread, theta / spread, atol=0.05)


def test_standard_errors_are_those_of_the_likelihood():
    u, y = siso(1, 3000, c=(0.6,))
    found = ARMAX(1, 1, 1).fit(u, y)
    spread = np.sqrt(np.diag(found.covariance_))

    def value(scaled):
        theta = found.theta_ + scaled * spread
        return likelihood(theta[3:], equation_errors(theta, u, y))

    steps = 0.1 * np.eye(4)
    curvature = [
        [value(i + j) - value(i - j) - value(j - i) + value(-i - j) for i in steps] for j in steps
    ]
    covariance = np.linalg.inv(-np.array(curvature) / 0.04)
    assert_allclose(found.covariance_ / np.outer(spread, spread), covariance, atol=0.15)


def test_errors_satisfy_the_equation():
    u, y = siso(0)
    found = ARMAX(1, 1, 1).fit(u, y)
    e, noise = found.residuals_[0], equation_errors(found.theta_, u, y)
    assert_allclose(e[1:] + found.C_[1, 0] * e[:-1], noise[1:], rtol=1e-8, atol=1e-10)
    _, squares = determinant_and_squares(noise, found.C_[1:, 0])
    assert found.loss_[0] == pytest.approx(squares / 299, rel=1e-8)
    # The one value before is as likely as the others make it.
    before = (noise[0] - e[0]) / found.C_[1, 0]
    assert np.sum(e**2) + before**2 == pytest.approx(found.loss_[0] * len(e), rel=1e-8)


@pytest.mark.parametrize("c", [[0.5], [-0.7, 0.3], [0.3, 0.2, -0.4]])
def test_derivatives_of_the_sum_of_squares(c):
    c = np.array(c)
    position = np.concatenate((np.arange(30), np.arange(40, 52), [60], np.arange(70, 72)))
    runs = np.split(np.arange(45), [30, 42, 43])
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(45, 3))
    found = fit_equation((columns, position), len(c), [c], limit=1)

    def squares(theta):
        noise = columns[:, 2] - columns[:, :2] @ theta[:2]
        return sum(determinant_and_squares(noise[run], theta[2:])[1] for run in runs)

    at = np.concatenate((found.theta, found.c))
    assert found.residual @ found.residual == pytest.approx(squares(at))
    numeric = [(squares(at + step) - squares(at - step)) / 2e-5 for step in 1e-5 * np.eye(len(at))]
    assert_allclose(-2.0 * found.sensitivity.T @ found.residual, numeric, atol=1e-6)


@pytest.mark.parametrize("c", [[0.5], [-0.7, 0.3], [0.3, 0.2, -0.4]])
def test_the_unknown_past_of_each_run(c):
    position = np.concatenate((np.arange(30), np.arange(40, 52), [60], np.arange(70, 72)))
    runs = np.split(np.arange(45), [30, 42, 43])
    noise = np.random.default_rng(0).normal(size=45)

    def terms(c):
        return np.sum([determinant_and_squares(noise[run], c) for run in runs], axis=0)

    fit = EquationFit(noise[:, None], position, np.array(c))
    assert (fit.log_det, fit.residual @ fit.residual) == pytest.approx(terms(c))

    def likelihood_loss(c):
        log_det, squares = terms(c)
        return 0.5 * (np.log(squares) + log_det / 45)

    steps = 1e-6 * np.eye(len(c))
    numeric = [(likelihood_loss(c - s) - likelihood_loss(c + s)) / 2e-6 for s in steps]
    assert_allclose(fit.descent[0], numeric, atol=1e-6)


def test_white_residuals_are_left():
    found = ARMAX(2, 2, NC).fit(record(3000, 4, 1.0))
    for e in found.residuals_:
        correlation = [e[lag:] @ e[:-lag] / (e @ e) for lag in range(1, 21)]
        assert np.abs(correlation).max() < 4.0 / np.sqrt(3000)


def test_information_criteria_are_those_of_the_gaussian_likelihood():
    data = record(500, 0, 1.0)
    arx = ARX(2, 2).fit(data)
    errors = np.column_stack(arx.residuals_)
    gauss = multivariate_normal(np.zeros(2), errors.T @ errors / 498)
    assert arx.log_likelihood_ == pytest.approx(gauss.logpdf(errors).sum())
    found = ARMAX(2, 2, NC).fit(data)
    assert found.n_rows_ == 498
    p = len(found.theta_)
    assert p == len(found.names_) == 2 * 9 + 3
    assert found.aic_ == pytest.approx(2 * p - 2 * found.log_likelihood_)
    assert found.bic_ == pytest.approx(np.log(498) * p - 2 * found.log_likelihood_)


def test_without_noise_lags_it_is_arx():
    data = record(noise=1.0)
    one, other = ARX(2, 2).fit(data), ARMAX(2, 2, 0).fit(data)
    assert_array_equal(other.theta_, one.theta_)
    assert_array_equal(other.covariance_, one.covariance_)


def test_an_unfinished_search_says_so():
    u, y = siso(0, c=(0.95, 0.3))
    found = ARMAX(1, 1, 2, max_iterations=1).fit(u, y)
    assert not found.converged_
    assert found.iterations_ == (1,)
    assert ARMAX(1, 1, 2).fit(u, y).loss_[0] < found.loss_[0]
    with pytest.raises(ModelError, match="max_iterations is 0; it must be 1 or more"):
        ARMAX(max_iterations=0).fit(u, y)


# --- records and gaps -----------------------------------------------------------------------


def test_the_noise_of_records_and_after_gaps_has_a_past_of_its_own():
    runs = [siso(seed, n) for seed, n in enumerate([150, 90])]
    together = ARMAX(1, 1, 1).fit([Dataset(u, y, 1.0) for u, y in runs])
    X, y = np.vstack([u for u, _ in runs]), np.concatenate([y for _, y in runs])
    arrays = ARMAX(1, 1, 1).fit(X, y, records=np.repeat([0, 1], [150, 90]))
    assert_array_equal(arrays.theta_, together.theta_)
    own = likelihood(together.theta_[3:], *(equation_errors(together.theta_, *r) for r in runs))
    assert together.log_likelihood_ == pytest.approx(own, rel=1e-9)
    spread = np.sqrt(np.diag(together.covariance_))
    assert together.log_likelihood_ == pytest.approx(
        most_likely(together.theta_, runs, spread)[1], abs=1e-3
    )
    # A lost sample takes two equations away: its own and that of the row after it.
    gap = Dataset(np.insert(X, 150, 0.0, axis=0), np.insert(y, 150, np.nan), 1.0)
    assert_allclose(ARMAX(1, 1, 1).fit(gap).theta_, together.theta_, rtol=1e-9)


def test_records_of_models_without_memory_do_not_touch_either():
    (u, y), (v, z) = siso(0, 150), siso(1, 90)
    apart = ARMAX(0, 1, 1, 0).fit([Dataset(u, y, 1.0), Dataset(v, z, 1.0)])
    gap = Dataset(np.vstack((u, [[0.0]], v)), np.concatenate((y, [np.nan], z)), 1.0)
    assert_allclose(ARMAX(0, 1, 1, 0).fit(gap).theta_, apart.theta_, rtol=1e-9)
    joined = Dataset(np.vstack((u, v)), np.concatenate((y, z)), 1.0)
    assert not np.allclose(ARMAX(0, 1, 1, 0).fit(joined).theta_, apart.theta_, rtol=1e-5)


def test_likelihood_counts_the_instants_known_for_all_outputs():
    data = record(500, 0, 1.0)
    data.outputs[200:230, 1] = np.nan
    found = ARX([[2, 0], [2, 2]], 2).fit(data)
    assert [len(e) for e in found.residuals_] == [498, 466]
    known = np.r_[0:198, 230:498]
    errors = np.column_stack((found.residuals_[0][known], found.residuals_[1]))
    gauss = multivariate_normal(np.zeros(2), errors.T @ errors / 466)
    assert found.n_rows_ == 466
    assert found.log_likelihood_ == pytest.approx(gauss.logpdf(errors).sum())


def test_many_gaps_cost_little():
    data = record(3000, 0, 1.0)
    lost = np.random.default_rng(1).random(3000) < 0.02
    gappy = Dataset(data.inputs, np.where(lost[:, None], np.nan, data.outputs), data.dt)
    whole, found = ARMAX(2, 2, NC).fit(data), ARMAX(2, 2, NC).fit(gappy)
    for value, error, truth in [
        (found.A_[1:], found.A_std_[1:], A[1:]),
        (found.C_[1:, 0], found.C_std_[1:, 0], C[1:, 0]),
    ]:
        assert np.abs((value - truth) / error).max() < 4.0
    assert np.all(found.A_std_ <= 1.25 * whole.A_std_)
    assert_allclose(found.noise_covariance_, whole.noise_covariance_, rtol=0.1, atol=0.2)


# --- predictions ----------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 3, 12])
def test_predictions_use_the_noise_that_was_seen(k):
    found = ARMAX(2, 2, NC).fit(record(1000, 0, 1.0))
    data = record(80, 9, 1.0)
    u, y = data.inputs, data.outputs
    errors = np.zeros((80, 2))
    model = (found.A_, found.B_, found.C_, found.offset_, u, y, errors)
    for t in range(2, 80):
        errors[t] = y[t] - forecast(*model, t, 1)
    predicted = found.predict_ahead(data, k=k)
    for t in range(k + 2, 80):
        assert_allclose(predicted[t], forecast(*model, t, k), rtol=1e-8, atol=1e-8)


def test_one_step_ahead_leaves_the_residuals():
    data = record(5000, noise=1.0)
    found = ARMAX(2, 2, NC).fit(data)
    # The first ones differ: predictions know nothing of the noise before, estimates guess it.
    left = (data.outputs - found.predict_ahead(data))[102:]
    assert_allclose(left, np.column_stack(found.residuals_)[100:], rtol=1e-6, atol=1e-8)


def test_errors_grow_from_the_noise_to_those_of_a_free_run():
    data = record(3000, 1, 1.0)
    found = ARMAX(2, 2, NC).fit(record(3000, 0, 1.0))
    errors = [
        (data.outputs - found.predict_ahead(data, k=k))[50:].std(axis=0) for k in (1, 2, 3, 60)
    ]
    assert_allclose(errors[0], SIGMA, rtol=0.05)
    assert np.all(np.diff(errors, axis=0) > 0.0)
    free = (data.outputs - found.simulate(data.inputs))[50:].std(axis=0)
    assert_allclose(errors[-1], free, rtol=1e-3)
    assert_allclose(found.predict_ahead(data, k=3000), found.simulate(data.inputs), rtol=1e-9)


def test_lost_samples_are_bridged_by_prediction():
    found = ARMAX(2, 2, NC).fit(record(1000, 0, 1.0))
    data = record(60, 9, 1.0)
    outputs = data.outputs.copy()
    outputs[20:23] = np.nan
    outputs[30, 1] = outputs[1, 0] = np.nan
    bridged, errors = outputs.copy(), np.zeros((60, 2))
    bridged[1, 0] = bridged[0, 0]
    model = (found.A_, found.B_, found.C_, found.offset_, data.inputs, bridged, errors)
    for t in range(2, 60):
        value = forecast(*model, t, 1)
        bridged[t] = np.where(np.isnan(outputs[t]), value, outputs[t])
        errors[t] = bridged[t] - value
    predicted = found.predict_ahead(Dataset(data.inputs, outputs, data.dt), k=2)
    for t in range(4, 60):
        assert_allclose(predicted[t], forecast(*model, t, 2), rtol=1e-8, atol=1e-8)


# --- stability ------------------------------------------------------------------------------


def test_stable_on_request():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(60, 1))
    noise = lfilter([1.0, 0.5], [1.0], 0.1 * rng.normal(size=60))
    y = lfilter([1.0], [1.0, -1.04], np.concatenate(([0.0], u[:-1, 0])) + noise)
    with pytest.warns(UserWarning, match=r"ARMAX model is unstable \(largest pole 1\.04"):
        wild = ARMAX(1, 1, 1).fit(u, y)
    found = ARMAX(1, 1, 1, stable=True).fit(u, y)
    assert found.reflected_
    assert found.A_[1, 0, 0] == pytest.approx(1.0 / wild.A_[1, 0, 0])
    assert found.loss_[0] > wild.loss_[0]

    def cost(rest):
        theta = np.concatenate((found.theta_[:1], rest))
        inside = abs(rest[2]) < 0.999
        return -likelihood(rest[2:], equation_errors(theta, u, y)) if inside else np.inf

    best = minimize(cost, found.theta_[1:], method="Nelder-Mead")
    assert found.log_likelihood_ == pytest.approx(-best.fun, abs=1e-3)


# --- beside another program -----------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_beside_pysid(seed):
    pysid = pytest.importorskip("pysid")
    rng = np.random.default_rng(seed)
    u = telegraph(rng, 1500)
    y = recursion(A, B, [0.0, 0.0], u, SIGMA * rng.normal(size=(1500, 2)), C)
    # It knows no units: outputs of one size serve both.
    y = y / y.std(axis=0)
    theirs = pysid.armax(
        [[2, 2], [2, 2]], [[1, 1], [1, 1]], [[2], [1]], [[1, 1], [1, 1]], u, y
    )  # fmt: skip
    ours = ARMAX(2, 2, NC, offset=False).fit(u, y)
    # It takes the samples before the record for zero, which here they are; ours leaves them out.
    for i in range(2):
        assert_allclose(ours.C_[: 3 - i, i], theirs.C[i, 0], atol=1e-2)
        for j in range(2):
            assert_allclose(ours.A_[:, i, j], theirs.A[i, j], atol=1e-3)
            assert_allclose(ours.B_[:, i, j], theirs.B[i, j], atol=1e-3)


def test_identity_polynomials_pass_noise_through():
    # A and B empty: predictions are those of the moving average alone.
    rng = np.random.default_rng(0)
    e = rng.normal(size=(400, 2))
    y = recursion(identity(2), np.zeros((1, 2, 1)), [1.0, 2.0], np.zeros((400, 1)), e, C)
    found = ARMAX(0, 0, NC).fit(np.zeros((400, 1)), y)
    assert_allclose(found.predict_ahead(np.zeros((400, 1)), y, 3), np.tile(found.offset_, (400, 1)))
