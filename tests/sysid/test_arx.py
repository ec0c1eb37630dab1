from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares
from scipy.signal import cont2discrete
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from sysid import ARMAX, ARX, Dataset, ModelError, fit_percent
from tests.sysid.linear_systems import (
    OFFSET,
    SIGMA,
    A,
    B,
    forecast,
    identity,
    record,
    recursion,
    telegraph,
)
from tests.sysid.support import scikit_learn_checks

WHITE = np.ones((1, 2))


def close(found, A, B, offset, rtol=1e-8):
    assert_allclose(found.A_, A, rtol=rtol, atol=1e-9)
    assert_allclose(found.B_, B, rtol=rtol, atol=1e-7)
    assert_allclose(found.offset_, offset, rtol=rtol, atol=1e-7)


# --- known systems --------------------------------------------------------------------------


def test_a_system_without_noise_is_found_exactly():
    found = ARX(2, 2).fit(record())
    close(found, A, B, OFFSET)
    assert found.stable_
    assert_allclose(found.loss_, 0.0, atol=1e-18 * record().outputs.var(axis=0).max())
    fresh = record(seed=1)
    assert_allclose(found.predict(fresh), fresh.outputs, rtol=1e-7, atol=1e-6)
    assert found.score(fresh) == pytest.approx(1.0, abs=1e-9)


def test_feed_through_and_delay():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(300, 2))
    direct = rng.normal(size=(2, 2, 2))
    close(ARX(2, 2, 0).fit(u, recursion(A, direct, OFFSET, u)), A, direct, OFFSET)
    late = np.concatenate((np.zeros((3, 2, 2)), direct))
    close(ARX(2, 2, 3).fit(u, recursion(A, late, OFFSET, u)), A, late, OFFSET)


def test_orders_for_each_entry():
    a, b = A.copy(), np.zeros((5, 2, 3))
    a[:, 0, 1] = 0.0
    b[1, 0, 0], b[3:5, 0, 2], b[0:2, 1, 1] = 2.0, (0.5, -1.5), (3.0, 70.0)
    u = np.random.default_rng(1).normal(size=(300, 3))
    found = ARX(
        na=[[2, 0], [2, 2]], nb=[[1, 0, 2], [0, 2, 0]], nk=[[1, 1, 3], [1, 0, 1]]
    ).fit(u, recursion(a, b, OFFSET, u))  # fmt: skip
    close(found, a, b, OFFSET)
    assert found.names_ == (
        "a1[0,0]", "a2[0,0]", "b1[0,0]", "b3[0,2]", "b4[0,2]", "offset[0]",
        "a1[1,0]", "a2[1,0]", "a1[1,1]", "a2[1,1]", "b0[1,1]", "b1[1,1]", "offset[1]",
    )  # fmt: skip
    assert found.theta_[found.names_.index("b4[0,2]")] == pytest.approx(-1.5)
    assert found.n_lags_ == 4


def test_inputs_alone_and_outputs_alone():
    rng = np.random.default_rng(2)
    u = rng.normal(size=(200, 2))
    fir = ARX(0, 3).fit(u, recursion(identity(2), B, OFFSET, u))
    assert_allclose(fir.B_[:3], B, atol=1e-9)
    assert_allclose(fir.B_[3], 0.0, atol=1e-9)
    assert fir.stable_
    assert fir.radius_ == 0.0
    decay = recursion(A, 0 * B, [0.0, 0.0], u[:60], past_y=np.array([[3.0, 100.0], [4.0, -50.0]]))
    close(ARX(2, 0, offset=False).fit(u[:60], decay), A, np.zeros((1, 2, 2)), [0.0, 0.0])


def test_a_sampled_motor_has_the_poles_of_the_motor():
    resistance, inductance, inertia, damping, constant = 1.0, 6e-4, 8e-7, 1.33e-5, 2.38e-2
    F = np.array([[-resistance / inductance, -constant / inductance],
                  [constant / inertia, -damping / inertia]])  # fmt: skip
    G = np.array([[1.0 / inductance, 0.0], [0.0, -1.0 / inertia]])
    sampled = cont2discrete((F, G, np.eye(2), np.zeros((2, 2))), 1e-3)
    rng = np.random.default_rng(0)
    u = telegraph(rng, 500) * [1.0, 0.01]
    y = np.zeros((500, 2))
    for t in range(1, 500):
        y[t] = sampled[0] @ y[t - 1] + sampled[1] @ u[t - 1]
    found = ARX(1, 1).fit(u, y, dt=1e-3)
    assert_allclose(-found.A_[1], sampled[0], rtol=1e-8)
    assert_allclose(found.B_[1], sampled[1], rtol=1e-8)
    poles = np.log(found.poles_) / found.dt_
    assert_allclose(np.sort_complex(poles), np.sort_complex(np.linalg.eigvals(F)), rtol=1e-7)


def test_more_lags_than_the_system_has_do_no_harm():
    found = ARX(5, 6).fit(record())
    fresh = record(seed=1)
    assert found.stable_
    assert_allclose(found.predict(fresh), fresh.outputs, rtol=1e-6, atol=1e-5)


# --- the estimate's statistics --------------------------------------------------------------


def test_least_squares_as_in_the_textbook():
    data = record(noise=1.0, C=WHITE)
    y, u = data.outputs, data.inputs
    rows = np.arange(2, len(y))
    phi = np.column_stack(
        [
            *(-y[rows - lag, j] for j in (0, 1) for lag in (1, 2)),
            *(u[rows - lag, j] for j in (0, 1) for lag in (1, 2)),
            np.ones(len(rows)),
        ]
    )
    inverse = np.linalg.inv(phi.T @ phi)
    theta = inverse @ phi.T @ y[rows]
    errors = y[rows] - phi @ theta
    sigma = errors.T @ errors / (len(rows) - 9)
    found = ARX(2, 2).fit(data)
    assert_allclose(found.theta_, theta.T.ravel(), rtol=1e-7)
    assert_allclose(found.noise_covariance_, sigma, rtol=1e-7)
    assert_allclose(found.covariance_, np.kron(sigma, inverse), rtol=1e-5, atol=1e-12)
    assert_allclose(np.column_stack(found.residuals_), errors, rtol=1e-6, atol=1e-7)
    assert_allclose(found.loss_, (errors**2).mean(axis=0))
    spread = np.sqrt(np.diag(found.covariance_))
    assert_allclose(found.A_std_[2, 1, 0], spread[found.names_.index("a2[1,0]")])
    assert_allclose(found.B_std_[1, 0, 1], spread[found.names_.index("b1[0,1]")])
    assert_allclose(found.offset_std_, spread[[8, 17]])
    assert_array_equal(found.A_std_[0], 0.0)


@pytest.mark.soak
def test_intervals_cover_what_they_claim():
    # Errors of the two outputs are correlated, so that estimates of both are, too.
    truth = ARX(2, 2).fit(record()).theta_
    mix = np.linalg.cholesky([[1.0, 0.7], [0.7, 1.0]]).T * SIGMA
    found = []
    for seed in range(250):
        rng = np.random.default_rng(seed)
        u = telegraph(rng, 250)
        y = recursion(A, B, OFFSET, u, rng.normal(size=(250, 2)) @ mix)
        found.append(ARX(2, 2).fit(u, y))
    theta = np.array([f.theta_ for f in found])
    spread = np.array([np.sqrt(np.diag(f.covariance_)) for f in found])
    inside = np.mean(np.abs(theta - truth) < 1.96 * spread)
    assert 0.93 < inside < 0.965
    predicted = np.mean([f.covariance_ for f in found], axis=0)
    names = found[0].names_
    for one, other in [("a1[0,0]", "a1[1,0]"), ("b1[0,0]", "b1[1,0]")]:
        i, j = names.index(one), names.index(other)
        scale = np.sqrt(predicted[i, i] * predicted[j, j])
        assert predicted[i, j] / scale == pytest.approx(0.7, abs=0.07)
        assert np.cov(theta.T)[i, j] / scale == pytest.approx(0.7, abs=0.2)


def test_what_the_data_do_not_tell_has_no_finite_error():
    rng = np.random.default_rng(0)
    u = telegraph(rng, 300)
    y = recursion(A, B, OFFSET, u, SIGMA * rng.normal(size=(300, 2)))
    once = ARX(2, 2).fit(u, y)
    twice = ARX(2, 2).fit(u[:, [0, 1, 1]], y)
    assert np.all(np.isinf(twice.B_std_[1:, :, 1:]))
    assert_allclose(twice.B_std_[:, :, 0], once.B_std_[:, :, 0], rtol=1e-6)
    assert_allclose(twice.A_std_, once.A_std_, rtol=1e-6)
    assert_allclose(twice.B_[:, :, 1] + twice.B_[:, :, 2], once.B_[:, :, 1], rtol=1e-6)
    assert_allclose(twice.predict(u[:, [0, 1, 1]]), once.predict(u), rtol=1e-6, atol=1e-6)


# --- operating point and units --------------------------------------------------------------


def test_another_zero_of_the_sensors_changes_the_offset_only():
    data = record(noise=1.0)
    du, dy = np.array([3.0, -5.0]), np.array([100.0, 1e4])
    shifted = Dataset(data.inputs + du, data.outputs + dy, data.dt)
    one, other = ARX(2, 2).fit(data), ARX(2, 2).fit(shifted)
    assert_allclose(other.A_, one.A_, rtol=1e-6)
    assert_allclose(other.B_, one.B_, rtol=1e-6)
    assert other.score(shifted) == pytest.approx(one.score(data), abs=1e-7)
    assert_allclose(other.simulate(shifted.inputs), one.simulate(data.inputs) + dy, rtol=1e-6)
    assert ARX(2, 2, offset=False).fit(shifted).score(shifted) < one.score(data) - 0.01


def test_units_do_not_matter():
    data = record(noise=1.0)
    units = np.array([1e-6, 1e5])
    other = ARX(2, 2).fit(Dataset(data.inputs * 1e-3, data.outputs * units, data.dt))
    one = ARX(2, 2).fit(data)
    assert_allclose(other.A_ * units / units[:, None], one.A_, rtol=1e-6)
    assert_allclose(other.A_std_ * units / units[:, None], one.A_std_, rtol=1e-6)
    assert_allclose(other.B_ * 1e-3 / units[:, None], one.B_, rtol=1e-6, atol=1e-9)


# --- records and gaps -----------------------------------------------------------------------


def test_records_of_different_length_give_one_set_of_coefficients():
    records = [record(n, seed, 1.0, name=f"run {seed}") for seed, n in enumerate([150, 90, 200])]
    found = ARX(2, 2).fit(records)
    close(ARX(2, 2).fit([record(60), record(40, 1)]), A, B, OFFSET)
    # No regressor crosses a boundary: a gap of lost samples as long as the lags does the same.
    gap = np.full((2, 2), np.nan)
    stacked = Dataset(
        np.vstack([rows for r in records for rows in (r.inputs, np.zeros((2, 2)))]),
        np.vstack([rows for r in records for rows in (r.outputs, gap)]),
        0.01,
    )
    assert_allclose(ARX(2, 2).fit(stacked).theta_, found.theta_, rtol=1e-9)
    assert_allclose(ARX(2, 2).fit(records[::-1]).theta_, found.theta_, rtol=1e-7)
    labels = np.repeat(["b", "a", "c"], [150, 90, 200])
    X, y = np.vstack([r.inputs for r in records]), np.vstack([r.outputs for r in records])
    arrays = ARX(2, 2).fit(X, y, records=labels)
    assert_array_equal(arrays.theta_, found.theta_)
    assert arrays.score(X, y, records=labels) == pytest.approx(found.score(records))
    assert_allclose(arrays.predict(X, records=labels)[150:240], arrays.predict(X[150:240]))
    assert not np.allclose(ARX(2, 2).fit(X, y).theta_, found.theta_, rtol=1e-6)


def test_a_record_too_short_to_have_a_past_adds_nothing():
    one = ARX(4, 4).fit(record(noise=1.0))
    both = ARX(4, 4).fit([record(noise=1.0), record(4, 5, 1.0)])
    assert_array_equal(both.theta_, one.theta_)


def test_lost_samples_leave_out_the_equations_that_need_them():
    data = record(noise=1.0)
    outputs = data.outputs.copy()
    outputs[50, 0] = outputs[120:125] = np.nan
    outputs[0, 1] = outputs[-1, 1] = np.nan
    gappy = Dataset(data.inputs, outputs, data.dt)
    found = ARX(2, 2).fit(gappy)
    y, u = outputs, data.inputs
    phi = np.hstack((-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones((398, 1))))
    for i, order in enumerate([[0, 2, 1, 3, 4, 6, 5, 7, 8]] * 2):
        rows = np.isfinite(phi).all(axis=1) & np.isfinite(y[2:, i])
        theta = np.linalg.lstsq(phi[rows], y[2:, i][rows])[0][order]
        assert_allclose(found.theta_[9 * i : 9 * i + 9], theta, rtol=1e-6)
        assert len(found.residuals_[i]) == rows.sum()
    # Lost samples of one output cost the other the equations they appear in, no more.
    assert [len(r) for r in found.residuals_] == [398 - 3 - 7 - 1, 398 - 2 - 7 - 2]
    exact = record()
    exact.outputs[50:60] = np.nan
    close(ARX(2, 2).fit(exact), A, B, OFFSET)


# --- free run -------------------------------------------------------------------------------


def test_free_run_is_the_recursion():
    found = ARX(2, 2).fit(record(noise=1.0))
    u = telegraph(np.random.default_rng(5), 5000)
    rest = {
        "past_y": np.tile(found.output_mean_, (2, 1)),
        "past_u": np.tile(found.input_mean_, (2, 1)),
    }
    expected = recursion(found.A_, found.B_, found.offset_, u, **rest)
    assert_allclose(found.simulate(u), expected, rtol=1e-9, atol=1e-9)
    assert_array_equal(found.predict(u), found.simulate(u))


def test_free_run_from_given_outputs():
    found = ARX(2, 2).fit(record(noise=1.0))
    u = telegraph(np.random.default_rng(5), 50)
    first = np.array([[3.0, 100.0], [-2.0, 400.0]])
    expected = recursion(found.A_, found.B_, found.offset_, u[2:], past_y=first, past_u=u[:2])
    y = found.simulate(u, initial=first)
    assert_array_equal(y[:2], first)
    assert_allclose(y[2:], expected, rtol=1e-9)
    one = found.simulate(u, initial=first[0])
    before = np.tile(found.input_mean_, (1, 1))
    held = np.vstack((first[0], first[0]))
    expected = recursion(
        found.A_, found.B_, found.offset_, u[1:], past_y=held, past_u=np.vstack((before, u[:1]))
    )
    assert_allclose(one[1:], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("lost", "held"), [((), (0, 1)), ((0,), (1, 1)), ((1, 40, 41), (0, 0)), ((0, 1), None)]
)
def test_a_free_run_over_a_record_starts_where_it_fits_best(lost, held):
    """The start that SciPy's least squares finds over ``simulate``."""
    found = ARX(2, 2).fit(record(noise=1.0))
    data = record(n=120, seed=3, noise=1.0)
    data.outputs[list(lost)] = np.nan
    seen = np.isfinite(data.outputs)
    start = np.tile(found.output_mean_, (2, 1)) if held is None else data.outputs[list(held)]
    measured = found.simulate(data.inputs, initial=start)
    unit = np.sqrt(np.mean(np.where(seen, measured - data.outputs, 0.0)[2:] ** 2, axis=0))

    def residual(values):
        free = found.simulate(data.inputs, initial=values.reshape(2, 2))
        return ((free - data.outputs) / unit)[seen]

    best = least_squares(residual, start.ravel(), x_scale=np.tile(unit, 2), xtol=1e-14, ftol=1e-14)
    expected = found.simulate(data.inputs, initial=best.x.reshape(2, 2))
    assert_allclose(found.predict(data) / unit, expected / unit, atol=1e-4)


def test_noise_in_the_first_rows_does_no_harm():
    found = ARX(2, 2).fit(record())
    clean = record(seed=3)
    noisy = Dataset(clean.inputs, clean.outputs.copy(), clean.dt)
    noisy.outputs[:2] += np.array([5.0, 500.0])
    assert_allclose(found.predict(noisy)[10:], clean.outputs[10:], rtol=0.02, atol=10.0)


# --- predictions ----------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2, 3, 10])
def test_predictions_are_the_recursion_from_the_data(k):
    found = ARX(2, 3, 0).fit(record(noise=1.0))
    data = record(60, seed=7, noise=1.0)
    y = found.predict_ahead(data, k=k)
    settings = (found.A_, found.B_, WHITE, found.offset_, data.inputs, data.outputs, None)
    for t in range(k + 1, 60):
        assert_allclose(y[t], forecast(*settings, t, k), rtol=1e-9, atol=1e-9)
    assert_array_equal(found.predict_ahead(data.inputs, data.outputs, k), y)


def test_one_step_ahead_leaves_the_residuals():
    data = record(noise=1.0)
    found = ARX(2, 2).fit(data)
    left = data.outputs - found.predict_ahead(data)
    assert_allclose(left[2:], np.column_stack(found.residuals_), rtol=1e-6, atol=1e-8)


def test_far_ahead_is_a_free_run():
    data = record(80, noise=1.0)
    found = ARX(2, 2).fit(data)
    free = found.simulate(data.inputs)
    for k in (80, 81, 10**6):
        assert_allclose(found.predict_ahead(data, k=k), free, rtol=1e-9)
    assert not np.allclose(found.predict_ahead(data, k=20), free)


def test_lost_samples_are_bridged_by_prediction():
    found = ARX(2, 2).fit(record(noise=1.0))
    data = record(60, seed=7, noise=1.0)
    outputs = data.outputs.copy()
    outputs[20:23] = np.nan
    outputs[30, 1] = np.nan
    settings = (found.A_, found.B_, WHITE, found.offset_, data.inputs)
    bridged = outputs.copy()
    for t in (20, 21, 22, 30):
        value = forecast(*settings, bridged, None, t, 1)
        bridged[t] = np.where(np.isnan(bridged[t]), value, bridged[t])
    gappy = Dataset(data.inputs, outputs, data.dt)
    for k in (1, 4):
        expected = found.predict_ahead(data.inputs, bridged, k)
        assert_allclose(found.predict_ahead(gappy, k=k), expected, rtol=1e-9)
        assert_allclose(expected[25], forecast(*settings, bridged, None, 25, k), rtol=1e-9)


# --- stability ------------------------------------------------------------------------------


def growing():
    """Forty samples of a system with a pole at 1.05."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(40, 2))
    a = np.array([np.eye(2), [[-1.05, 0.0], [0.3, -0.5]]])
    b = np.array([np.zeros((2, 2)), np.eye(2)])
    return u, recursion(a, b, [0.0, 0.0], u, 0.01 * rng.normal(size=(40, 2)))


def test_an_unstable_model_is_said_to_be():
    with pytest.warns(UserWarning, match=r"largest pole 1\.05.*stable=True"):
        found = ARX(1, 1).fit(*growing())
    assert not found.stable_
    assert found.radius_ == pytest.approx(1.05, abs=1e-3)
    assert found.radius_ == abs(found.poles_[0])
    assert not found.reflected_
    with np.errstate(all="raise"):
        assert not np.all(np.isfinite(found.simulate(np.ones((20000, 2)))))
    u = np.ones((20000, 2))
    assert found.score(Dataset(u, u + np.arange(20000)[:, None], 1.0)) == -np.inf


def test_stable_on_request():
    u, y = growing()
    with pytest.warns(UserWarning):
        wild = ARX(1, 1).fit(u, y)
    found = ARX(1, 1, stable=True).fit(u, y)
    assert found.stable_
    assert found.reflected_
    expected = [1.0 / wild.poles_[0], wild.poles_[1]]
    assert_allclose(sorted(found.poles_), sorted(expected), rtol=1e-9)
    # B and the offset are then the best for that A.
    target = y[1:] + y[:-1] @ found.A_[1].T
    phi = np.hstack((u[:-1], np.ones((39, 1))))
    theta = np.linalg.lstsq(phi, target)[0]
    assert_allclose(found.B_[1], theta[:2].T, rtol=1e-8)
    assert_allclose(found.offset_, theta[2], rtol=1e-8)
    assert np.all(np.isnan(found.A_std_[1]))
    assert np.all(found.B_std_[1] > 0)
    assert_array_equal(found.theta_[found.names_.index("a1[1,0]")], found.A_[1, 1, 0])


@pytest.mark.filterwarnings("ignore:the ARX model is unstable")
@pytest.mark.parametrize("na", [2, [[2, 1], [1, 2]]])
def test_the_rest_is_estimated_again_for_the_mended_model(na):
    rng = np.random.default_rng(0)
    u = rng.normal(size=(60, 1))
    a = np.array([np.eye(2), [[-1.5, 0.1], [0.4, -0.9]], [[0.45, 0.0], [0.0, 0.3]]])
    y = recursion(a, np.ones((3, 2, 1)), [1.0, 0.0], u, 0.1 * rng.normal(size=(60, 2)))
    wild, found = ARX(na, 2).fit(u, y), ARX(na, 2, stable=True).fit(u, y)
    assert wild.radius_ > 1.0
    assert found.radius_ < 1.0
    # The stable modes keep their poles and their directions among the outputs.
    for pole in wild.poles_[np.abs(wild.poles_) < 1.0]:
        direction = np.linalg.svd(sum(wild.A_ * pole ** -np.arange(3)[:, None, None]))[2][-1]
        left = sum(found.A_ * pole ** -np.arange(3)[:, None, None]) @ direction.conj()
        assert_allclose(left, 0.0, atol=1e-7)
    target = y[2:] + y[1:-1] @ found.A_[1].T + y[:-2] @ found.A_[2].T
    phi = np.hstack((u[1:-1], u[:-2], np.ones((58, 1))))
    theta = np.linalg.lstsq(phi, target)[0]
    assert_allclose(found.B_[1:, :, 0], theta[:2], rtol=1e-7)
    assert_allclose(found.offset_, theta[2], rtol=1e-7)
    assert_allclose(np.column_stack(found.residuals_), target - phi @ theta, rtol=1e-6, atol=1e-8)


def test_a_model_mended_in_spite_of_gaps():
    u, y = growing()
    y[20, 0] = np.nan
    # The mended A lets the first output's equation depend on the second too: a row more is lost.
    found = ARX([[1, 0], [0, 1]], 1, stable=True).fit(u, y)
    y[30, 1] = np.nan
    fewer = ARX([[1, 0], [0, 1]], 1, stable=True).fit(u, y)
    assert found.reflected_
    assert fewer.reflected_
    assert [len(e) for e in fewer.residuals_] == [
        len(e) - n for e, n in zip(found.residuals_, (1, 2), strict=True)
    ]
    assert np.all(np.isfinite(fewer.B_std_))


def test_stable_models_are_left_alone():
    assert_array_equal(
        ARX(2, 2, stable=True).fit(record(noise=1.0)).theta_,
        ARX(2, 2).fit(record(noise=1.0)).theta_,
    )


@pytest.mark.filterwarnings("ignore:the ARX model is unstable")
@pytest.mark.parametrize("seed", range(20))
def test_every_unstable_pole_is_mirrored_and_the_others_stay(seed):
    rng = np.random.default_rng(seed)
    q, lags = rng.integers(1, 4), rng.integers(1, 4)
    a = np.concatenate((identity(q), 0.8 * rng.normal(size=(lags, q, q))))
    u = rng.normal(size=(40, 1))
    y = recursion(a, np.ones((2, q, 1)), np.zeros(q), u, rng.normal(size=(40, q)))
    before = np.linalg.eigvals(_companion(ARX(lags, 1).fit(u, y).A_))
    after = np.linalg.eigvals(_companion(ARX(lags, 1, stable=True).fit(u, y).A_))
    size = np.abs(before)
    wanted = np.where(size >= 1.0, before / size * np.minimum(1.0 / size, 0.9999), before)
    assert_allclose(np.sort_complex(after), np.sort_complex(wanted), rtol=1e-5, atol=1e-6)


def _companion(A):
    lags, q = len(A) - 1, A.shape[1]
    F = np.eye(lags * q, k=-q)
    F[:q] = -np.hstack(list(A[1:]))
    return F


# --- score ----------------------------------------------------------------------------------


def test_score_is_the_mean_fit_of_free_runs():
    found = ARX(2, 2).fit(record(noise=1.0))
    records = [record(200, 1, 1.0), record(90, 2, 1.0)]
    fits = [fit_percent(r.outputs, found.predict(r)) for r in records]
    assert found.score(records) == pytest.approx(np.mean(fits) / 100.0)
    one = records[0]
    assert found.score(one.inputs, one.outputs) == pytest.approx(found.score(one))
    still = Dataset(one.inputs, one.outputs * [1.0, 0.0], one.dt)
    moving = fit_percent(still.outputs, found.predict(still))[0]
    assert found.score(still) == pytest.approx(moving / 100.0)


# --- wrong use ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"na": -1}, "na is -1; it must be 0 or more"),
        ({"nb": [[1, 1], [1, -2]]}, "nb is .*must be 0 or more"),
        ({"nk": -1}, "nk is -1"),
        ({"na": 1.5}, "na is 1.5; it must be a whole number"),
        ({"na": "2"}, "na is '2'; it must be a whole number"),
        ({"na": True}, "na is True; it must be a whole number"),
        ({"na": [1, 2]}, r"na has shape \(2,\).*outputs x outputs: \(2, 2\)"),
        ({"nb": [[1, 1, 1]]}, r"nb has shape \(1, 3\).*outputs x inputs: \(2, 2\)"),
        ({"na": [[1], [1, 2]]}, r"na is ragged.*\(2, 2\)"),
        ({"na": 0, "nb": 0, "offset": False}, "output 0 has no coefficients"),
        ({"na": 80, "nb": 80}, "output 0 has 320 rows.*321 coefficients: lower na"),
        ({"na": 400}, "output 0 has 0 rows"),
    ],
)
def test_orders_that_make_no_sense(settings, message):
    with pytest.raises(ModelError, match=message):
        ARX(**settings).fit(record())


def test_data_that_make_no_sense():
    u, y = record().inputs, record().outputs
    model = ARX(2, 2)
    with pytest.raises(ModelError, match="400 rows of inputs, 399 of outputs"):
        model.fit(u, y[:-1])
    with pytest.raises(ModelError, match="target y is None: give Datasets"):
        model.fit(u)
    with pytest.raises(ModelError, match="leave y out"):
        model.fit(record(), y)
    with pytest.raises(ValueError, match="X contains NaN"):
        model.fit(np.where(u > 0, u, np.nan), y)
    with pytest.raises(ValueError, match="y contains infinity"):
        model.fit(u, np.where(y > 0, y, np.inf))
    with pytest.raises(ModelError, match=r"run 2: its sample time is 0.02 s, that of run 1 0.01 s"):
        model.fit([record(name="run 1"), Dataset(u, y, 0.02, "run 2")])
    with pytest.raises(ModelError, match="run 2: 1 inputs and 2 outputs, but run 1 has 2 and 2"):
        model.fit([record(name="run 1"), Dataset(u[:, :1], y, 0.01, "run 2")])
    with pytest.raises(ModelError, match=r"records has shape \(3,\) for 400 rows"):
        model.fit(u, y, records=[1, 2, 3])
    with pytest.raises(ModelError, match="sort the rows by record"):
        model.fit(u, y, records=np.arange(400) % 2)
    with pytest.raises(ModelError, match="sample time -1"):
        model.fit(u, y, dt=-1.0)


def test_use_that_makes_no_sense():
    u, y = record().inputs, record().outputs
    model = ARX(2, 2).fit(record())
    with pytest.raises(
        ModelError, match=r"data: its sample time is 0.02 s, that of the model 0.01"
    ):
        model.predict(Dataset(u, y, 0.02))
    with pytest.raises(ModelError, match="2 inputs and 1 outputs, but the model has 2 and 2"):
        model.score(Dataset(u, y[:, 0], 0.01))
    for call in (model.predict, model.predict_ahead):
        with pytest.raises(ModelError, match="one Dataset at a time"):
            call([record(), record()])
    for k in (0, -1, 1.5, True):
        with pytest.raises(ModelError, match=f"k is {k}; predict 1 or more"):
            model.predict_ahead(record(), k=k)
    with pytest.raises(ModelError, match=r"initial has shape \(3,\).*one to 400 rows of 2"):
        model.simulate(u, initial=np.ones(3))
    with pytest.raises(ModelError, match="one to 400 rows of 2"):
        model.simulate(u, initial=np.ones((401, 2)))
    with pytest.raises(ModelError, match="initial has an output that is not finite"):
        model.simulate(u, initial=[[np.nan, 1.0]])
    with pytest.raises(ValueError, match=r"X has 1 features.*expecting 2"):
        model.predict(u[:, :1])
    for call in (ARX().predict, ARX().simulate):
        with pytest.raises(NotFittedError):
            call(u)


# --- as scikit-learn expects ----------------------------------------------------------------


def expected_failures(model):
    """Checks that a model of a process in time cannot pass, with the reason."""
    return {
        "check_methods_sample_order_invariance": "the order of the rows is time",
        "check_methods_subset_invariance": "an output depends on all the inputs before it",
        "check_regressor_multioutput": "10 rows for 16 or more coefficients are refused",
    }


# nk=0, because scikit-learn's rows have no time: an output depends on its own row.
@pytest.mark.soak
@scikit_learn_checks(
    [ARX(1, 1, 0), ARMAX(1, 1, 1, 0), ARMAX(1, 1, 1, 0, stable=True, offset=False)],
    expected_failed_checks=expected_failures,
)
@pytest.mark.filterwarnings("ignore:.*SCIPY_ARRAY_API", "ignore:.*does not inherit")
def test_scikit_learn_checks(estimator, check):
    check(estimator)


def test_many_outputs_pass_what_the_check_of_ten_rows_cannot():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(100, 10)), rng.normal(size=(100, 5))
    predicted = ARX(1, 1, 0).fit(u, y).predict(u)
    assert predicted.shape == y.shape
    assert predicted.dtype == np.float64


def test_parameters_are_stored_as_given_and_cloned():
    na = [[1, 0], [2, 1]]
    model = ARX(na, 3, 0, offset=False, stable=True)
    assert model.get_params() == {"na": na, "nb": 3, "nk": 0, "offset": False, "stable": True}
    assert clone(model).get_params() == model.get_params()


def test_records_arrays_and_frames_serve_alike():
    data = record(noise=1.0)
    one = ARX(2, 2).fit(data)
    frame = pd.DataFrame(data.inputs, columns=["motor", "brake"])
    for other in (
        ARX(2, 2).fit(data.inputs, data.outputs, dt=data.dt),
        ARX(2, 2).fit(frame, pd.DataFrame(data.outputs)),
        ARX(2, 2).fit([data]),
    ):
        assert_array_equal(other.theta_, one.theta_)
    assert one.dt_ == data.dt
    assert one.fit(data) is one
    with pytest.raises(ModelError, match=r"sample time is 0.02 s"):
        one.score(data.inputs, data.outputs, dt=0.02)
    flat = ARX(2, 2).fit(data.inputs, data.outputs[:, 0])
    assert flat.predict(data.inputs).shape == flat.simulate(data.inputs).shape == (400,)
    assert flat.predict_ahead(data.inputs, data.outputs[:, 0], 2).shape == (400,)
    assert flat.predict(Dataset(data.inputs, data.outputs[:, 0], 1.0)).shape == (400, 1)
