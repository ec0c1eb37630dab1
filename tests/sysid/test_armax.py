from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import approx_fprime, least_squares
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from sysid import ARMAX, ARX, Dataset, ModelError
from sysid.linear.orders import Orders
from sysid.linear.prediction_error import fit_row
from sysid.linear.regression import equations
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


def one_step_errors(theta, u, y):
    """Innovations of y(t) + a y(t-1) = b u(t-1) + offset + e(t) + c e(t-1), one by one."""
    a, b, offset, c = theta
    errors = [0.0]
    for t in range(1, len(y)):
        errors.append(y[t] + a * y[t - 1] - b * u[t - 1, 0] - offset - c * errors[-1])
    return np.array(errors[1:])


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


@pytest.mark.parametrize("seed", range(10))
def test_it_is_the_minimum_that_a_general_solver_finds(seed):
    u, y = siso(seed, c=(0.9 * (-1) ** seed,))
    found = ARMAX(1, 1, 1).fit(u, y)
    other = least_squares(one_step_errors, [-0.7, 1.0, 0.3, 0.9 * (-1) ** seed], args=(u, y))
    errors = one_step_errors(found.theta_, u, y)
    assert_allclose(found.residuals_[0], errors, rtol=1e-8, atol=1e-10)
    assert found.loss_[0] * 299 == pytest.approx(2.0 * other.cost, rel=1e-7)
    assert_allclose(found.theta_, other.x, rtol=2e-3, atol=1e-4)
    inverse = np.linalg.inv(other.jac.T @ other.jac)
    assert_allclose(found.covariance_, 2.0 * other.cost / 295 * inverse, rtol=0.05, atol=1e-7)


def test_the_gradient_vanishes_at_the_minimum():
    u, y = siso(0)
    found = ARMAX(1, 1, 1).fit(u, y)
    spread = np.sqrt(np.diag(found.covariance_))

    def loss(scaled):
        return np.sum(one_step_errors(scaled * spread, u, y) ** 2)

    at_minimum = approx_fprime(found.theta_ / spread, loss, 1e-4)
    away = approx_fprime(found.theta_ / spread + 1.0, loss, 1e-4)
    assert np.abs(at_minimum).max() < 2e-3 * np.abs(away).max()


def test_derivatives_of_the_errors():
    data = record(200, noise=1.0)
    data.outputs[70] = np.nan
    orders = Orders.of(2, 2, na=2, nb=2, nc=2, nk=1, offset=True)
    rows = equations([data, record(80, 1, 1.0)], orders, 1, orders.lag)
    found = fit_row(rows, 2, [np.array([0.5, 0.1])])

    def errors(theta):
        return recursive_errors(rows, theta[:-2], theta[-2:])

    at = np.concatenate((found.theta, found.c))
    assert_allclose(found.residual, errors(at), rtol=1e-9, atol=1e-9)
    for j, column in enumerate(found.sensitivity.T):
        step = np.zeros(len(at))
        step[j] = 1e-5 * max(abs(at[j]), 1.0)
        numeric = (errors(at - step) - errors(at + step)) / (2.0 * step[j])
        assert_allclose(column, numeric, rtol=1e-5, atol=1e-5 * np.abs(column).max())


def recursive_errors(rows, theta, c):
    """Errors that start anew wherever rows do not follow each other in time."""
    equation_errors = rows.target - rows.regressors @ theta
    errors, run = [], 0
    for t, value in enumerate(equation_errors):
        run = run + 1 if t and rows.position[t] == rows.position[t - 1] + 1 else 0
        past = sum(c[lag - 1] * errors[t - lag] for lag in range(1, min(len(c), run) + 1))
        errors.append(value - past)
    return np.array(errors)


def test_white_residuals_are_left():
    found = ARMAX(2, 2, NC).fit(record(3000, 4, 1.0))
    for e in found.residuals_:
        correlation = [e[lag:] @ e[:-lag] / (e @ e) for lag in range(1, 21)]
        assert np.abs(correlation).max() < 4.0 / np.sqrt(3000)


def test_information_criteria_are_those_of_the_gaussian_likelihood():
    found = ARMAX(2, 2, NC).fit(record(500, 0, 1.0))
    errors = np.column_stack(found.residuals_)
    gauss = multivariate_normal(np.zeros(2), errors.T @ errors / 498)
    assert found.n_rows_ == 498
    assert found.log_likelihood_ == pytest.approx(gauss.logpdf(errors).sum())
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


def test_records_and_gaps_start_the_noise_anew():
    runs = [siso(seed, n) for seed, n in enumerate([150, 90])]
    together = ARMAX(1, 1, 1).fit([Dataset(u, y, 1.0) for u, y in runs])
    X, y = np.vstack([u for u, _ in runs]), np.concatenate([y for _, y in runs])
    arrays = ARMAX(1, 1, 1).fit(X, y, records=np.repeat([0, 1], [150, 90]))
    assert_array_equal(arrays.theta_, together.theta_)
    errors = np.concatenate([one_step_errors(together.theta_, *run) for run in runs])
    assert_allclose(together.residuals_[0], errors, rtol=1e-8, atol=1e-10)

    def all_errors(theta):
        return np.concatenate([one_step_errors(theta, *run) for run in runs])

    best = least_squares(all_errors, together.theta_)
    assert together.residuals_[0] @ together.residuals_[0] == pytest.approx(2 * best.cost, rel=1e-6)
    # A lost sample takes two equations away: its own and that of the row after it.
    gap = Dataset(np.vstack((X[:150], [[0.0]], X[150:])), np.insert(y, 150, np.nan), 1.0)
    assert_allclose(ARMAX(1, 1, 1).fit(gap).theta_, together.theta_, rtol=1e-9)


def test_many_gaps_do_not_bias():
    data = record(3000, 0, 1.0)
    lost = np.random.default_rng(1).random(3000) < 0.02
    found = ARMAX(2, 2, NC).fit(
        Dataset(data.inputs, np.where(lost[:, None], np.nan, data.outputs), data.dt)
    )
    # C starts at zero after each of 60 gaps, which costs precision.
    assert np.abs((found.A_ - A)[1:] / found.A_std_[1:]).max() < 4.5
    assert_allclose(found.C_, C, atol=0.1)


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
    data = record(noise=1.0)
    found = ARMAX(2, 2, NC).fit(data)
    left = (data.outputs - found.predict_ahead(data))[2:]
    assert_allclose(left, np.column_stack(found.residuals_), rtol=1e-6, atol=1e-8)


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

    def errors(rest):
        return one_step_errors((found.A_[1, 0, 0], *rest), u, y)

    best = least_squares(errors, found.theta_[1:], bounds=([-9, -9, -1], [9, 9, 1]))
    assert found.loss_[0] * 59 == pytest.approx(2.0 * best.cost, rel=1e-3)


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
