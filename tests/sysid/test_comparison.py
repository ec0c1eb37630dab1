"""Comparison of structures: evidence that colour does not inflate, and verdicts that follow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats
from scipy.signal import lfilter

from sysid import ARX, GASSI, Dataset, ModelError, Parameter, fit_percent
from sysid.judging.comparison import Candidate, compare
from sysid.judging.evidence import independent_samples, ratio_of_means
from tests.sysid.support import lag


def coloured(rng, n, rho):
    """A stationary AR(1) of unit variance."""
    e = np.sqrt(1.0 - rho**2) * rng.normal(size=n)
    e[0] /= np.sqrt(1.0 - rho**2)
    return lfilter([1.0], [1.0, -rho], e)


# --- evidence -------------------------------------------------------------------------------


def test_white_losses_have_the_interval_of_students_t():
    """For losses that hardly differ the logarithm of the ratio is their relative difference."""
    rng = np.random.default_rng(0)
    b = rng.uniform(50.0, 150.0, 400)
    a = b + rng.normal(0.1, 1.0, 400)
    found = ratio_of_means([a], [b])
    assert found.value == pytest.approx(a.mean() / b.mean())
    d = (a - b) / b.mean()
    low, high = stats.t.interval(0.95, 399, d.mean(), d.std() / 20.0)
    # The correlation of white noise is small, not zero.
    assert found.low - 1.0 == pytest.approx(low, abs=0.1 * (high - low))
    assert found.high - 1.0 == pytest.approx(high, abs=0.1 * (high - low))
    assert found.p_value == pytest.approx(stats.ttest_1samp(d, 0.0).pvalue, abs=0.05)


@pytest.mark.parametrize("rho", [0.0, 0.8, 0.95])
def test_intervals_of_coloured_losses_cover_the_ratio(rho):
    """Chi-square losses of equal size, of residuals as coloured as free runs leave them."""
    rng = np.random.default_rng(1)

    def losses():
        return [coloured(rng, n, rho) ** 2 for n in (2000, 1000)]

    found = [ratio_of_means(losses(), losses()) for _ in range(400)]
    covered = np.mean([f.low <= 1.0 <= f.high for f in found])
    assert 0.90 <= covered <= 0.99
    assert covered == pytest.approx(np.mean([f.p_value >= 0.05 for f in found]))
    assert all(f.low < f.value < f.high for f in found)
    # An interval for white noise would not have covered it: chi-square losses have variance 2.
    naive = [abs(np.log(f.value)) <= 1.96 * np.sqrt(4.0 / 3000) for f in found]
    assert rho == 0.0 or np.mean(naive) < 0.8


def test_a_much_larger_loss_is_not_hidden_by_its_own_spread():
    rng = np.random.default_rng(4)
    small, large = coloured(rng, 300, 0.95) ** 2, 1e4 * coloured(rng, 300, 0.95) ** 2
    found = ratio_of_means([large], [small])
    assert found.low > 100.0 and found.p_value < 0.01
    swapped = ratio_of_means([small], [large])
    assert swapped.value == pytest.approx(1.0 / found.value)
    assert swapped.high == pytest.approx(1.0 / found.low)
    assert swapped.p_value == pytest.approx(found.p_value)


def test_losses_that_are_equal_or_none():
    one = [np.ones(9)]
    assert ratio_of_means(one, one).p_value == 1.0
    assert ratio_of_means([np.zeros(9)], [np.zeros(9)]).value == 1.0
    assert ratio_of_means(one, [np.zeros(9)]).low == np.inf
    assert ratio_of_means([np.zeros(9)], one).high == 0.0


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_coloured_samples_are_worth_what_the_closed_form_says(rho):
    rng = np.random.default_rng(2)
    records = [coloured(rng, n, rho)[:, None] for n in (20_000, 10_000)]
    # The sum of rho^(2|k|) over all lags.
    expected = 30_000 * (1.0 - rho**2) / (1.0 + rho**2)
    assert independent_samples(records) == pytest.approx(expected, rel=0.05)


def test_the_worth_of_samples_does_not_depend_on_how_outputs_are_mixed():
    rng = np.random.default_rng(3)
    x = np.column_stack([coloured(rng, 3000, 0.8), coloured(rng, 3000, 0.3)])
    mixed = x @ np.array([[1.0, 1e3], [-2.0, 5e2]])
    assert independent_samples([mixed]) == pytest.approx(independent_samples([x]), rel=1e-6)
    # A copy of an output adds nothing.
    copied = np.column_stack([x[:, 0], 3.0 * x[:, 0]])
    assert independent_samples([copied]) == pytest.approx(independent_samples([x[:, :1]]))


# --- verdicts -------------------------------------------------------------------------------


def records(n=800, seed=0, scale=(1.0, 50.0)):
    """Two outputs with white noise, and what they are without it."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(n)
    clean = np.column_stack([np.sin(5 * t), np.cos(3 * t)]) * scale
    noise = 0.1 * rng.normal(size=(n, 2)) * scale
    return Dataset(np.zeros((n, 1)), clean + noise, 0.01), clean


TRAINING, TRAINED = records(seed=1)
VALIDATION, TESTED = records(seed=2)


def candidate(name, k, wrong=0.0, validation_wrong=None, n_lags=0):
    """A structure whose free runs are off by ``wrong`` noise levels, in turns of 40 samples."""
    offset = np.where(np.arange(800) // 20 % 2 == 0, 1.0, -1.0)[:, None] * [0.1, 5.0]
    tested = wrong if validation_wrong is None else validation_wrong
    return Candidate(name, k, k, (TRAINED + wrong * offset,), (TESTED + tested * offset,), n_lags)


def found(*candidates, validation=(VALIDATION,)):
    return compare(candidates, [TRAINING], validation)


def test_the_better_structure_wins_by_more_than_chance():
    result = found(candidate("wrong", 3, 1.0), candidate("right", 5))
    assert [row.name for row in result.rows] == ["right", "wrong"]
    right, wrong = result.rows
    assert (right.verdict, wrong.verdict, result.preferred) == ("best", "worse", "right")
    # Noise of one and an offset of one: twice the squares.
    assert wrong.ratio.value == pytest.approx(2.0, abs=0.15)
    assert wrong.ratio.low > 1.8 and wrong.ratio.high < 2.2 and wrong.ratio.p_value < 1e-6
    assert "right explains the validation data best. wrong has squared errors" in result.verdict
    assert f"{wrong.ratio.value:.2f} times those of right" in result.verdict
    assert "worse, by more than chance (p < 0.001)" in result.verdict


def test_metrics_are_those_of_the_free_runs():
    result = found(candidate("wrong", 3, 1.0), candidate("right", 5))
    row = result.row("wrong")
    offset = np.where(np.arange(800) // 20 % 2 == 0, 1.0, -1.0)[:, None] * [0.1, 5.0]
    simulated = TESTED + offset
    peak = np.abs(VALIDATION.outputs).max(axis=0)
    assert_allclose(row.fit, fit_percent(VALIDATION.outputs, simulated))
    error = simulated - VALIDATION.outputs
    assert_allclose(row.rmse, np.sqrt(np.mean(error**2, axis=0)) / peak)
    assert_allclose(row.msd, error.mean(axis=0) / peak)


def test_the_simpler_of_equals_is_preferred():
    result = found(candidate("rich", 9), candidate("plain", 4, 0.05))
    assert result.rows[0].name == "rich" and result.row("plain").verdict == "as good"
    assert result.preferred == "plain"
    assert "plain is preferred: it has 4 effective parameters, rich has 9." in result.verdict
    # The richer one is not preferred for being as good.
    assert found(candidate("rich", 9, 0.02), candidate("plain", 4)).preferred == "plain"


def test_strong_evidence_of_the_training_data_outweighs_simplicity():
    def against(wrong):
        plain = candidate("plain", 4, 1.0, validation_wrong=wrong)
        return found(candidate("rich", 9, validation_wrong=0.03), plain)

    ahead, behind = against(0.029), against(0.05)
    assert [ahead.rows[0].name, behind.rows[0].name] == ["plain", "rich"]
    for result in (ahead, behind):
        assert result.rows[1].verdict == "as good" and result.preferred == "rich"
        assert result.verdict.endswith("is strong evidence against it. rich is preferred.")


def test_a_difference_nobody_would_notice_makes_none():
    """Surely worse, by half a per cent of the squared error."""
    many = [Dataset(VALIDATION.inputs, VALIDATION.outputs, 0.01, str(k)) for k in range(40)]
    runs = [candidate("rich", 9), candidate("plain", 4, 0.07)]
    runs = [Candidate(c.name, c.n_free, c.n_effective, c.training, c.validation * 40) for c in runs]
    result = compare(runs, [TRAINING], many)
    assert result.row("plain").ratio.value < 1.01
    assert result.preferred == "plain"


def test_criteria_are_the_gaussian_ones_over_all_outputs():
    rich, plain = candidate("rich", 9), candidate("plain", 4, 0.3)
    result = found(rich, plain)
    n = result.n_independent
    assert result.n_samples == 800 and n == pytest.approx(800, rel=0.1)

    def log_det(c):
        residual = c.training[0] - TRAINING.outputs
        return np.log(np.linalg.det(residual.T @ residual / 800))

    aic = [n * log_det(c) + 2 * c.n_effective for c in (rich, plain)]
    bic = [n * log_det(c) + np.log(n) * c.n_effective for c in (rich, plain)]
    assert result.row("rich").daic - result.row("plain").daic == pytest.approx(aic[0] - aic[1])
    assert result.row("rich").dbic - result.row("plain").dbic == pytest.approx(bic[0] - bic[1])
    assert min(row.daic for row in result.rows) == min(row.dbic for row in result.rows) == 0.0


def test_without_validation_bic_ranks_and_that_is_said():
    result = found(candidate("rich", 9), candidate("plain", 4), validation=())
    assert [row.name for row in result.rows] == ["plain", "rich"] and not result.validated
    # Five parameters more for the same fit.
    assert result.row("rich").dbic == pytest.approx(5 * np.log(result.n_independent))
    assert result.row("rich").verdict == "worse" and np.isnan(result.rows[0].rmse).all()
    assert result.verdict.startswith("Without validation data this ranks by BIC")
    close = found(candidate("a", 4), candidate("b", 4, 0.01), validation=())
    assert close.rows[1].verdict == "as good"


def test_units_of_the_outputs_do_not_matter():
    units = np.array([1e-6, 1e4])

    def scaled(record):
        return Dataset(record.inputs, record.outputs * units, record.dt)

    runs = [candidate("wrong", 3, 1.0), candidate("right", 5)]
    other = [
        Candidate(
            c.name, c.n_free, c.n_effective, (c.training[0] * units,), (c.validation[0] * units,)
        )
        for c in runs
    ]
    one = found(*runs)
    two = compare(other, [scaled(TRAINING)], [scaled(VALIDATION)])
    assert two.row("wrong").ratio.value == pytest.approx(one.row("wrong").ratio.value)
    assert two.row("wrong").dbic == pytest.approx(one.row("wrong").dbic)
    assert_allclose(two.row("wrong").rmse, one.row("wrong").rmse)


def test_a_free_run_out_of_bounds_has_failed():
    wild = candidate("wild", 2)
    with np.errstate(over="ignore"):
        wild = replace(wild, validation=(TESTED * np.exp(np.arange(800))[:, None],))
    result = found(wild, candidate("right", 5))
    assert result.row("wild").verdict == "failed" and result.preferred == "right"
    assert np.isinf(result.row("wild").rmse).all()
    assert "wild failed: its free run grows out of bounds" in result.verdict
    with pytest.raises(ModelError, match="no structure has a free run"):
        found(wild)


def test_lost_samples_and_an_output_that_was_not_measured_do_not_count():
    lost = VALIDATION.outputs.copy()
    lost[100:300, 0] = np.nan
    lost[:, 1] = np.nan
    record = Dataset(VALIDATION.inputs, lost, 0.01)
    result = found(candidate("wrong", 3, 1.0), candidate("right", 5), validation=(record,))
    assert np.isnan(result.row("right").rmse[1]) and result.row("right").rmse[0] > 0.0
    kept = np.r_[0:100, 300:800]
    error = (TESTED - VALIDATION.outputs)[kept, 0]
    wrong = error + np.where(np.arange(800) // 20 % 2 == 0, 0.1, -0.1)[kept]
    ratio = result.row("wrong").ratio
    assert ratio.value == pytest.approx(np.mean(wrong**2) / np.mean(error**2))
    assert 1.3 < ratio.low < ratio.value < ratio.high < 2.5
    peak = np.abs(VALIDATION.outputs[kept, 0]).max()
    assert result.row("right").rmse[0] == pytest.approx(np.sqrt(np.mean(error**2)) / peak)


def test_all_are_judged_on_the_rows_that_each_had_to_explain():
    spoilt = VALIDATION.outputs.copy()
    spoilt[:5] += 1e3
    record = Dataset(VALIDATION.inputs, spoilt, 0.01)
    result = found(candidate("a", 3, 1.0, n_lags=5), candidate("b", 5), validation=(record,))
    assert result.rows[0].name == "b" and result.rows[0].rmse.max() < 0.2


@given(st.lists(st.floats(0.0, 3.0), min_size=2, max_size=5))
def test_no_structure_has_a_lower_loss_than_the_best(wrongs):
    result = found(*(candidate(str(i), i + 1, w) for i, w in enumerate(wrongs)))
    assert result.rows[0].verdict == "best"
    for row in result.rows[1:]:
        assert row.ratio.value >= 1.0 - 1e-9
        assert row.ratio.low <= row.ratio.value <= row.ratio.high


def test_names_must_differ():
    with pytest.raises(ModelError, match="different names"):
        found(candidate("a", 3), candidate("a", 4))


# --- fitted structures ----------------------------------------------------------------------


def measured(seed, n=300, tau=0.05):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 10), 10)
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = 2.0 * u[k] + (y[k] - 2.0 * u[k]) * np.exp(-0.01 / tau)
    return Dataset(u, y + 0.02 * rng.normal(size=n), 0.01)


def twofold_derivative(x, u, p):
    return ((p[0] * p[2] * u[0] - x[0]) / p[1],)


def static_derivative(x, u, p):
    return ((p[0] * u[0] - x[0]) / 1e-3,)


@pytest.mark.soak
def test_only_what_the_data_determine_counts():
    twofold = lag(
        name="twofold",
        derivative=twofold_derivative,
        parameters=(*lag().parameters, Parameter("more", "1", 1.0, 0.1, 10.0, "log")),
    )
    static = lag(name="static", derivative=static_derivative, parameters=lag().parameters[:1])
    training, validation = [measured(0)], [measured(1)]
    candidates = []
    for model in (lag(), twofold, static):
        estimator = GASSI(model, population=40, generations=6).fit(training)
        candidates.append(Candidate.of(model.name, estimator, training, validation))
    candidates.append(Candidate.of("ARX", ARX(2, 2).fit(training), training, validation))
    assert [(c.n_free, c.n_effective) for c in candidates] == [(2, 2), (3, 2), (1, 1), (5, 5)]
    result = compare(candidates, training, validation)
    assert result.row("static").verdict == "worse"
    assert result.row("twofold").verdict in ("best", "as good")
    assert result.preferred in ("lag", "twofold")
    assert result.row("lag").dbic == pytest.approx(result.row("twofold").dbic, abs=1e-3)


def test_outputs_that_are_never_measured_at_once_are_no_free_runs_that_fail():
    outputs = np.random.default_rng(0).standard_normal((40, 2))
    outputs[::2, 0], outputs[1::2, 1] = np.nan, np.nan
    records = [Dataset(np.zeros(40), outputs, 0.01)]
    run = np.zeros((40, 2))
    candidates = [Candidate(name, 1, 1, (run,), ()) for name in "ab"]
    with pytest.raises(ModelError, match="no sample of the training records has all outputs"):
        compare(candidates, records, [])
