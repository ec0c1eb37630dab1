from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from sysid import ARMAX, ARX, Dataset, ModelError, evaluate, select_orders
from sysid.linear import tuned
from tests.sysid.linear_systems import record, telegraph

TRAINING = [record(600, 0, 1.0), record(400, 1, 1.0)]
VALIDATION = record(500, 2, 1.0)


def orders(selection):
    return [
        tuple(c.orders[name] for name in ("na", "nb", "nc", "nk")) for c in selection.candidates
    ]


# --- what is chosen -------------------------------------------------------------------------


@pytest.mark.soak
def test_bic_finds_the_orders_of_the_system():
    found = select_orders(
        ARMAX(), TRAINING, criterion="bic", na=range(1, 4), nb=range(1, 4), nc=range(4), nk=(1, 2)
    )
    assert found.best.orders == {"na": 2, "nb": 2, "nc": 2, "nk": 1}
    assert len(found.candidates) == 3 * 3 * 4 * 2
    assert np.all(np.diff([c.bic for c in found.candidates if c.stable]) >= 0.0)
    assert sorted(found.candidates, key=lambda c: not c.stable) == list(found.candidates)
    by_aic = select_orders(ARMAX(), TRAINING, criterion="aic", na=range(1, 5), nb=(2,), nc=(0, 2))
    assert np.all(np.diff([c.aic for c in by_aic.candidates]) >= 0.0)
    assert by_aic.best.orders["na"] >= 2


def test_free_runs_over_a_record_held_back():
    found = select_orders(ARMAX(), TRAINING, VALIDATION, na=range(1, 5), nb=range(1, 4), nc=(0, 2))
    assert np.all(np.diff([c.score for c in found.candidates]) <= 0.0)
    assert found.best.orders["na"] >= 2
    assert found.best.orders["nb"] >= 2
    # As good, within what one record can tell, as the orders that made the data.
    true = next(c for c in found.candidates if list(c.orders.values()) == [2, 2, 2, 1])
    assert found.best.score - true.score < 0.01
    assert found.best.score > 0.85
    assert found.model.score(VALIDATION) == pytest.approx(found.best.score, abs=0.01)


def test_a_candidate_tells_how_it_did():
    found = select_orders(ARMAX(), TRAINING, [VALIDATION, record(80, 3, 1.0)], na=(1, 3), nb=(4,))
    best, model = found.best, found.model
    metrics = [
        evaluate(r.outputs[4:], model.predict(r)[4:]) for r in (VALIDATION, record(80, 3, 1.0))
    ]
    assert_allclose(best.fit, np.mean([m.fit for m in metrics], axis=0))
    assert_allclose(best.rmse, np.mean([m.rmse for m in metrics], axis=0))
    assert best.score == pytest.approx(best.fit.mean() / 100.0)
    assert best.n_parameters == len(model.theta_)
    assert (best.aic, best.bic, best.radius) == (model.aic_, model.bic_, model.radius_)
    assert best.stable
    assert best.converged
    assert not best.problem


def test_without_validation_there_is_no_fit():
    best = select_orders(ARX(), TRAINING, criterion="bic", na=(1, 2)).best
    assert np.all(np.isnan(best.fit))
    assert np.isnan(best.score)


# --- fairness -------------------------------------------------------------------------------


def test_all_are_judged_on_the_same_rows():
    found = select_orders(ARX(), TRAINING, criterion="bic", na=(1, 5), nb=(1, 8))
    alone = select_orders(ARX(), TRAINING, criterion="bic", na=(1,), nb=(1,))
    small = next(c for c in found.candidates if c.orders == {"na": 1, "nb": 1, "nk": 1})
    # 8 rows of each record have no complete past of 8; alone it has all but one.
    u, y = TRAINING, []
    for r in u:
        y.append(Dataset(r.inputs[7:], r.outputs[7:], r.dt))
    assert small.bic == pytest.approx(ARX(1, 1).fit(y).bic_)
    assert alone.best.bic == pytest.approx(ARX(1, 1).fit(u).bic_)
    assert small.bic != pytest.approx(alone.best.bic)


@pytest.mark.soak
def test_units_do_not_change_the_choice():
    units = np.array([1e-6, 1e4])
    scaled = [Dataset(r.inputs, r.outputs * units, r.dt) for r in (*TRAINING, VALIDATION)]
    grid = {"na": (1, 2, 3), "nb": (1, 2), "nc": (0, 1, 2)}
    for criterion in ("fit", "bic"):
        one = select_orders(ARMAX(), TRAINING, VALIDATION, criterion=criterion, **grid)
        other = select_orders(ARMAX(), scaled[:2], scaled[2], criterion=criterion, **grid)
        assert orders(other)[:3] == orders(one)[:3]
        assert_allclose(other.best.fit, one.best.fit, rtol=1e-5)
        assert_allclose(other.best.rmse, one.best.rmse, rtol=1e-5)


def growing(seed=0):
    """A record whose first-order ARX model is unstable, its second-order one too."""
    u = telegraph(np.random.default_rng(seed), 60, 1)
    y = np.zeros(60)
    for t in range(1, 60):
        y[t] = 1.03 * y[t - 1] + u[t - 1, 0]
    return Dataset(u, y + 0.01 * np.random.default_rng(seed + 1).normal(size=60), 0.01)


def test_an_unstable_model_is_never_chosen():
    data = growing()
    with pytest.raises(ModelError, match=r"none of the 2 candidates is stable: .*stable=True"):
        select_orders(ARX(), data, criterion="bic", na=(1, 2))
    found = select_orders(ARX(), data, data, na=(0, 1, 2), nb=(3,))
    assert found.best.orders["na"] == 0
    assert [c.stable for c in found.candidates] == [True, False, False]
    mended = select_orders(ARX(stable=True), data, data, na=(1, 2))
    assert mended.best.stable
    assert mended.best.reflected
    assert mended.model.stable_


def test_a_candidate_that_cannot_be_fitted_says_why():
    short = record(40, 0, 1.0)
    found = select_orders(ARX(), short, VALIDATION, na=(1, 2, 20))
    assert [c.orders["na"] for c in found.candidates[::2]] == [2, 20]
    assert found.candidates[-1].problem.startswith("output 0 has 20 rows")
    assert not found.candidates[-1].stable
    with pytest.raises(ModelError, match="none of the 1 candidates can be used; the first: outp"):
        select_orders(ARX(), short, VALIDATION, na=(20,))


# --- use ------------------------------------------------------------------------------------


@pytest.mark.soak
def test_threads_do_not_change_the_result():
    grid = {"na": (1, 2, 3), "nb": (1, 2), "nc": (0, 2)}
    one = select_orders(ARMAX(), TRAINING, VALIDATION, **grid)
    two = select_orders(ARMAX(), TRAINING, VALIDATION, threads=2, **grid)
    assert orders(two) == orders(one)
    assert_array_equal(two.model.theta_, one.model.theta_)


def test_orders_not_given_are_the_estimators():
    estimator = ARMAX(3, 2, 1, stable=True)
    found = select_orders(estimator, TRAINING, VALIDATION, nk=(1, 2))
    assert orders(found) == [(3, 2, 1, 1), (3, 2, 1, 2)]
    assert found.model.stable
    assert not hasattr(estimator, "A_")
    tables = select_orders(ARX(), TRAINING, VALIDATION, na=([[1, 0], [0, 1]], [[2, 2], [2, 2]]))
    assert tables.best.orders["na"] == [[2, 2], [2, 2]]


@pytest.mark.soak
def test_tuning_holds_the_ends_back_and_then_fits_the_whole():
    grid = {"na": (1, 2, 3), "nb": (1, 2), "nc": (0, 2), "nk": (1,)}
    found = tuned(ARMAX(stable=True), TRAINING, **grid)
    cut = [round(0.7 * r.n_samples) for r in TRAINING]
    by_hand = select_orders(
        ARMAX(stable=True),
        [r.part(0, k, "begin") for r, k in zip(TRAINING, cut, strict=True)],
        [r.part(k, r.n_samples, "end") for r, k in zip(TRAINING, cut, strict=True)],
        **grid,
    )
    assert orders(found) == orders(by_hand)
    whole = ARMAX(stable=True, **found.best.orders).fit(TRAINING)
    assert_array_equal(found.model.theta_, whole.theta_)
    # By itself it tries a wide grid, without the orders that an ARX model lacks.
    assert len(tuned(ARX(stable=True), TRAINING[0]).candidates) == 6 * 4 * 2


def test_the_example_of_the_documentation_runs(capsys):
    text = (Path(__file__).parents[2] / "docs" / "armax.md").read_text("utf-8")
    names = {}
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL).group(1), names)
    assert names["found"].best.score > 0.7
    assert names["model"].A_[1, 0, 0] == pytest.approx(-0.9, abs=0.01)
    assert names["ahead"].shape == names["free_run"].shape == (800, 1)
    assert "+-" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"validation": None}, "criterion 'fit' needs validation records: hold one back"),
        ({"criterion": "r2"}, "unknown criterion 'r2'; choose from fit, aic, bic"),
        ({"nc": (1,)}, "ARX has no nc; leave it out"),
        ({"na": ()}, "na is empty"),
        ({"na": (-1,)}, "na is -1; it must be 0 or more"),
        ({"threads": 0}, "threads is 0"),
        ({"training": np.ones((9, 2))}, "training must be a Dataset or several"),
        ({"validation": Dataset(np.ones((9, 2)), np.ones((9, 2)), 0.5)}, "sample time is 0.5 s"),
        ({"validation": Dataset(np.ones((9, 1)), np.ones((9, 2)), 0.01)}, "1 inputs and 2 outp"),
    ],
)
def test_use_that_makes_no_sense(change, message):
    given = {"training": TRAINING, "validation": VALIDATION} | change
    with pytest.raises(ModelError, match=message):
        select_orders(ARX(), **given)
