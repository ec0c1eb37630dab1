"""GASSI as scikit-learn expects an estimator to behave."""

import numpy as np
import pytest
from sklearn.model_selection import GroupKFold, cross_val_score

from sysid import GASSI, Input, Output, Parameter, ProcessModel, State
from tests.sysid.support import motor, motor_record, scikit_learn_checks


def fading(x, u, p):
    return (-x[0],)


def weighted_sum(x, u, p):
    total = x[0] + p[-1]
    for gain, signal in zip(p, u, strict=False):
        total = total + gain * signal
    return (total,)


def sums(n_inputs):
    """A sum of the inputs, weighted by the parameters, and an offset."""
    gains = [Parameter(f"gain{i}", "1", 0.0, -1e3, 1e3, minimum=-1e6) for i in range(n_inputs)]
    return ProcessModel(
        name=f"sum of {n_inputs}",
        states=(State("fading", "1"),),
        inputs=tuple(Input(f"u{i}", "1") for i in range(n_inputs)),
        outputs=(Output("y", "1"),),
        parameters=(*gains, Parameter("offset", "1", 0.0, -1e3, 1e3, minimum=-1e6)),
        derivative=fading,
        output=weighted_sum,
    )


class AnyWidth(GASSI):
    """A GASSI whose model has as many inputs as the arrays.

    The checks bring arrays of any width; a model has the inputs that its equations have.
    """

    def _model(self):
        return sums(self.n_features_in_)


def expected_failures(model):
    """Checks that no model of given equations can pass, with the reason."""
    return {"check_regressor_multioutput": "a model has the outputs that its equations have"}


@pytest.mark.soak
@scikit_learn_checks(
    [AnyWidth(population=8, generations=2, dt=1.0)], expected_failed_checks=expected_failures
)
@pytest.mark.filterwarnings("ignore:.*SCIPY_ARRAY_API", "ignore:.*does not inherit")
def test_scikit_learn_checks(estimator, check):
    check(estimator)


def test_records_of_arrays_are_folds_of_a_cross_validation():
    record = motor_record(n=240)
    groups = np.repeat([0, 1, 2], 80)
    estimator = GASSI(motor(), population=40, generations=6, dt=record.dt)
    scores = cross_val_score(
        estimator, record.inputs, record.outputs, groups=groups, cv=GroupKFold(3),
        params={"records": groups},
    )  # fmt: skip
    # Each part but the first starts from where an array does not tell: from rest.
    assert scores.shape == (3,) and np.all(np.isfinite(scores))
    assert scores.max() > 0.9
