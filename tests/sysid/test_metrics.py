from __future__ import annotations

import numpy as np
import pytest

from sysid import evaluate, fit_percent, msd, rmse

MEASURED = np.array([[1.0, 10.0], [2.0, 10.0], [3.0, 10.0], [-4.0, 10.0]])
SIMULATED = np.array([[1.5, 11.0], [2.5, 11.0], [2.5, 11.0], [-4.5, 9.0]])


def test_rmse_and_msd_by_hand():
    # Errors 0.5, 0.5, -0.5, -0.5 and 1, 1, 1, -1.
    assert rmse(MEASURED, SIMULATED) == pytest.approx([0.5, 1.0])
    assert msd(MEASURED, SIMULATED) == pytest.approx([0.0, 0.5])
    assert rmse(MEASURED, SIMULATED, np.array([4.0, 10.0])) == pytest.approx([0.125, 0.1])


def test_msd_is_positive_when_the_simulation_is_above():
    assert msd(np.zeros((2, 1)), np.ones((2, 1))) == pytest.approx([1.0])


def test_fit_by_hand():
    # Mean 0.5; squared distances 0.25 + 2.25 + 6.25 + 20.25 = 29; squared errors sum to 1.
    fit = fit_percent(MEASURED, SIMULATED)
    assert fit[0] == pytest.approx(100.0 * (1.0 - np.sqrt(1.0 / 29.0)))
    assert np.isnan(fit[1])  # a constant has no spread to explain
    assert fit_percent(MEASURED, MEASURED)[0] == 100.0
    assert np.isnan(fit_percent(np.full((1000, 1), 0.1), np.zeros((1000, 1)))).all()
    mean = np.broadcast_to(MEASURED.mean(axis=0), MEASURED.shape)
    assert fit_percent(MEASURED, mean)[0] == pytest.approx(0.0)


def test_lost_samples_do_not_count():
    gaps = np.vstack([MEASURED, [[np.nan, np.nan]]])
    guess = np.vstack([SIMULATED, [[1e6, 1e6]]])
    for metric in (rmse, msd, fit_percent):
        np.testing.assert_allclose(metric(gaps, guess), metric(MEASURED, SIMULATED))


def test_a_failed_simulation_does_not_look_good():
    failed = SIMULATED.copy()
    failed[3:] = np.nan
    assert not np.isfinite(rmse(MEASURED, failed)).any()
    assert not np.isfinite(msd(MEASURED, failed)).any()
    assert not np.isfinite(fit_percent(MEASURED, failed)).any()


def test_evaluate_normalises_by_the_largest_magnitude():
    result = evaluate(MEASURED, SIMULATED)
    assert result.scale == pytest.approx([4.0, 10.0])
    assert result.rmse == pytest.approx([0.5 / 4.0, 1.0 / 10.0])
    assert result.msd == pytest.approx([0.0, 0.5 / 10.0])
    assert result.fit[0] == fit_percent(MEASURED, SIMULATED)[0]


def test_an_output_that_was_never_measured_has_no_metrics():
    unseen = MEASURED.copy()
    unseen[:, 1] = np.nan
    result = evaluate(unseen, SIMULATED)
    assert result.rmse[0] == pytest.approx(0.125)
    assert np.isnan(result.rmse[1])
    assert result.scale[1] == 1.0
