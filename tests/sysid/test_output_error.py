"""Output-error models against brute force, known systems and repeated experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.signal import lfilter

from sysid import ARX, OE, Dataset, ModelError, select_orders
from sysid.examples import lag, lag_record
from sysid.problem.regressors import with_regressors
from tests.sysid.linear_systems import telegraph

# Poles at 0.9 +- 0.17i of the first output, at 0.7 of the second; each its own inputs.
F = ([1.0, -1.8, 0.84], [1.0, -0.7])
GAINS = ([0.05, 0.02], [-20.0, 6.0])
OFFSET = (0.1, 3.0)


def measured(n, seed, noise=(0.3, 10.0), lost=0.0):
    """Outputs of two filters from rest, white noise on the sensors alone."""
    rng = np.random.default_rng(seed)
    u = telegraph(rng, n, 2)
    delayed = np.vstack((np.zeros((1, 2)), u[:-1]))
    drives = [delayed @ gains + offset for gains, offset in zip(GAINS, OFFSET, strict=True)]
    clean = np.column_stack([lfilter([1.0], f, d) for f, d in zip(F, drives, strict=True)])
    y = clean + rng.normal(size=clean.shape) * noise
    y[rng.random(y.shape) < lost] = np.nan
    return Dataset(u, y, 0.01)


def test_exact_data_give_the_system_back_over_gaps_and_several_records():
    records = [measured(200, 1, (0.0, 0.0), lost=0.2), measured(90, 2, (0.0, 0.0))]
    model = OE(nf=(2, 1), nb=1).fit(records)
    assert_allclose(model.A_[1:, 0, 0], F[0][1:], atol=1e-6)
    assert_allclose(model.A_[1:, 1, 1], [-0.7, 0.0], atol=1e-6)
    assert_allclose(model.B_[1], GAINS, rtol=1e-5)
    assert_allclose(model.offset_, OFFSET, rtol=1e-5)
    assert model.converged_ and model.stable_ and not np.any(model.A_[1:, [0, 1], [1, 0]])


def test_no_other_coefficients_have_a_smaller_free_run_error():
    u, y = (part[:, 0] for part in (measured(150, 3).inputs, measured(150, 3).outputs))
    model = OE(nf=1, nb=2).fit(u[:, None], y)

    def squares(theta):  # sample by sample, from an open start
        f, b1, b2, offset, w = theta
        total = 0.0
        for t in range(2, len(y)):
            w = -f * w + b1 * u[t - 1] + b2 * u[t - 2] + offset
            total += (y[t] - w) ** 2
        return total

    start = [-0.8, 0.1, 0.1, 0.1, y[1]]
    options = {"maxiter": 4000, "maxfev": 4000, "xatol": 1e-9, "fatol": 1e-12}
    brute = minimize(squares, start, method="Nelder-Mead", options=options)
    assert_allclose(model.loss_[0] * (len(y) - 2), brute.fun, rtol=1e-6)
    assert_allclose(model.A_[1, 0, 0], brute.x[0], rtol=1e-3)
    simulated = model.predict(Dataset(u, y, 0.01))[2:, 0]
    assert np.sum((simulated - y[2:]) ** 2) < 1.005 * brute.fun  # its start fits all rows


def test_noise_on_the_sensors_does_not_bias_it_and_its_standard_errors_hold():
    fits = [OE(nf=(2, 1), nb=1).fit(measured(250, seed)) for seed in range(60)]
    estimates = np.array([fit.A_[1, [0, 1], [0, 1]] for fit in fits])
    stated = np.mean([fit.A_std_[1, [0, 1], [0, 1]] for fit in fits], axis=0)
    spread = estimates.std(axis=0, ddof=1)
    assert_allclose(stated, spread, rtol=0.35)  # a standard deviation of 60: +-9 %
    assert np.all(np.abs(estimates.mean(axis=0) - [-1.8, -0.7]) < 4.0 * spread / np.sqrt(60))
    equation_error = ARX(na=2, nb=1).fit(measured(250, 0))
    assert abs(equation_error.A_[1, 0, 0] + 1.8) > 0.3  # which is what it is for


def test_its_predictions_are_its_free_run():
    model, record = OE(nf=(2, 1), nb=1).fit(measured(300, 5)), measured(100, 6)
    first = record.outputs[: model.n_lags_]
    free_run = model.simulate(record.inputs, first)
    for k in (1, 7):
        assert_allclose(model.predict_ahead(record, k=k)[12:], free_run[12:], rtol=1e-9)


def test_each_output_gets_orders_of_its_own():
    training, validation = measured(200, 24), measured(400, 25)
    found = select_orders(OE(), training, validation, nf=(1, 2, 3), nb=(1, 2), nk=(1,))
    mixed, *alike = sorted(found.candidates, key=lambda c: isinstance(c.orders["nf"], int))
    assert len(alike) == 6 and len(set(mixed.orders["nf"])) == 2
    assert_allclose(mixed.fit, np.max([c.fit for c in alike], axis=0), rtol=1e-2)
    assert found.best is mixed and found.model.nf == mixed.orders["nf"]
    by_bic = select_orders(OE(), training, criterion="bic", nf=(1, 2), nb=(1,), nk=(1,))
    assert by_bic.best.orders == {"nf": 2, "nb": 1, "nk": 1}


def test_roots_beyond_the_circle_are_mirrored():
    rng = np.random.default_rng(9)
    u = rng.normal(size=60)
    y = lfilter([0.0, 1.0], [1.0, -1.05], u)  # grows without bounds
    model = OE(nf=1, nb=1).fit(u[:, None], y)
    assert model.stable_ and np.all(np.isfinite(model.predict(Dataset(u, y, 1.0))))


@pytest.mark.parametrize(
    ("orders", "n", "what"),
    [
        ({"nf": (1, 2, 3)}, 50, "nf has shape (3,); give one number, or one per output: (2,)"),
        ({"nf": -1}, 50, "nf is -1; it must be 0 or more"),
        ({"nf": 3}, 8, "output 0 has 5 measured rows with a complete past for 11 coefficients"),
        ({"max_iterations": 0}, 50, "max_iterations is 0"),
    ],
)
def test_orders_that_make_no_sense_are_refused(orders, n, what):
    with pytest.raises(ModelError) as refused:
        OE(**orders).fit(measured(n, 0))
    assert what in str(refused.value)


def test_a_regressor_makes_what_is_no_linear_model_one():
    rng = np.random.default_rng(10)
    u, w = telegraph(rng, 400, 1)[:, 0], np.zeros(400)
    for t in range(1, 400):  # damped by a torque that turns with the speed
        w[t] = 0.98 * w[t - 1] + u[t - 1] - 0.5 * np.sign(w[t - 1])
    record = Dataset(u, w, 0.01)
    model = replace(lag(), regressors=lambda record: {"sign": np.sign(record["y"])})
    extended, names = with_regressors(model, record)
    assert names == ("sign",) and extended.inputs.shape == (400, 2)
    plain = OE(nf=1, nb=1, nk=1).fit(record)
    informed = OE(nf=1, nb=1, nk=[[1, 0]]).fit(extended)
    assert informed.score(extended) > 0.999 > 0.95 > plain.score(record)
    assert_allclose(informed.B_[0, 0, 1], -0.5, rtol=1e-3)


def test_lost_samples_of_a_regressor_are_held_and_nonsense_is_refused():
    record = lag_record()
    y = record.outputs.copy()
    y[[0, 4, 5]] = np.nan
    record = replace(record, outputs=y)
    model = replace(lag(), regressors=lambda record: {"y": record["y"]})
    extended, _ = with_regressors(model, record)
    expected = y[[1, 1, 1, 2, 3, 3, 3, 6], 0]
    assert_allclose(extended.inputs[:8, 1], expected)
    assert with_regressors(lag(), record)[1] == ()
    for wrong, what in (
        (lambda record: {"y": record["y"][1:]}, "regressor 'y' has shape"),
        (lambda record: {"y": record["x"]}, "has no signal 'x' in it"),
        (lambda record: {"y": 1 / 0}, "regressors(record) fails: ZeroDivisionError"),
    ):
        with pytest.raises(ModelError) as refused:
            with_regressors(replace(lag(), regressors=wrong), record)
        assert what in str(refused.value)
