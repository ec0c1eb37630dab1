"""Several records in one objective, against the same sums over SciPy's simulations."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from sysid import GASSI, BatchSimulator, Dataset, ModelError, SearchSpace
from sysid.fitting.objective import Objective
from tests.sysid.reference import simulate
from tests.sysid.support import motor, motor_inputs, motor_record

WEIGHTS = np.array([3.0, 1.0])


def logs():
    """Three records of different length, rate and size, noisy, with samples and outputs lost."""
    rng = np.random.default_rng(3)
    records = []
    for n, dt, size in ((120, 0.01, 1.0), (37, 0.02, 0.3), (400, 0.004, 2.0)):
        record = motor_record(n, dt, amplitude=0.01 * size)
        outputs = record.outputs + 0.02 * rng.normal(size=(n, 2)) * np.abs(record.outputs).max(0)
        records.append(Dataset(record.inputs, outputs, dt, f"{n} samples"))
    records[0].outputs[40:60] = np.nan
    records[1].outputs[:, 1] = np.nan
    records[2].outputs[::7, 0] = np.nan
    return records


@functools.cache
def reference(vector, k):
    """What SciPy simulates of the k-th log; other cases ask for the same again."""
    return simulate(motor(), np.array(vector), logs()[k])


def expected(vector, records, per_log, balance, weights):
    """The objective by its definition."""
    peaks = np.array([np.nanmax(np.abs(r.outputs), axis=0, initial=0.0) for r in records])
    scales = peaks if per_log else np.broadcast_to(peaks.max(axis=0), peaks.shape)
    means = []
    for j in range(2):
        squares = [
            ((reference(tuple(vector), k)[:, j] - r.outputs[:, j]) / scales[k, j]) ** 2
            for k, r in enumerate(records)
            if np.isfinite(r.outputs[:, j]).any()
        ]
        if balance == "logs":
            means.append(np.mean([np.nanmean(s) for s in squares]))
        else:
            means.append(np.nanmean(np.concatenate(squares)))
    return np.sqrt(means) @ weights / weights.sum()


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("per_log", [False, True])
@pytest.mark.parametrize("balance", ["samples", "logs"])
def test_the_objective_of_uneven_logs_is_that_of_scipy(per_log, balance):
    model, records = motor(), logs()
    vectors = np.stack([model.nominal, 1.3 * model.nominal])
    objective = Objective(
        BatchSimulator(model, accuracy=1e-7), SearchSpace.of(model), records,
        per_log=per_log, balance=balance, weights=WEIGHTS,
    )  # fmt: skip
    truth = [expected(v, records, per_log, balance, WEIGHTS) for v in vectors]
    np.testing.assert_allclose(objective.evaluate(vectors)[0], truth, rtol=1e-5)
    # Refinement sees the same figure.
    steps = [64] * len(records)
    np.testing.assert_allclose(
        objective.error_of(objective.residuals(vectors, steps).rms), truth, rtol=1e-5
    )


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore:All-NaN slice")
def test_the_fit_of_uneven_logs_is_a_minimum_of_it():
    """No parameter moved by half a per cent makes SciPy's figure better."""
    model, records = motor(2.0), logs()
    found = GASSI(
        model, population=60, generations=8, balance="logs", criterion="error", accuracy=1e-6,
        weights={"current": 3.0},
    ).fit(records)  # fmt: skip
    at = expected(found.vector_, records, False, "logs", WEIGHTS)
    assert found.error_ == pytest.approx(at, rel=1e-4)
    for i in range(len(found.vector_)):
        for factor in (0.995, 1.005):
            moved = found.vector_.copy()
            moved[i] *= factor
            assert expected(moved, records, False, "logs", WEIGHTS) > at * (1 - 1e-7)


def test_equal_logs_are_balanced_already():
    model, record = motor(), motor_record(80)
    vectors = 1.2 * model.nominal[None]
    found = [
        Objective(
            BatchSimulator(model), SearchSpace.of(model), [record, record], balance=balance
        ).evaluate(vectors)[0]
        for balance in ("samples", "logs")
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-14)


def test_a_long_log_rules_unless_logs_count_alike():
    """Two logs of motors that differ: what is found lies nearer to the one that counts more."""
    model = motor(2.0)
    heavy = model.nominal * [1.4, 1, 1, 1, 1]
    other = Dataset(motor_inputs(30), np.full((30, 2), np.nan), 0.01)
    outputs = BatchSimulator(model, accuracy=1e-7).trajectories(heavy, other)[0]
    records = [motor_record(300), Dataset(other.inputs, outputs, 0.01)]
    resistances = [
        GASSI(model, population=40, generations=6, balance=balance).fit(records)
        .parameters_["resistance"]
        for balance in ("samples", "logs")
    ]  # fmt: skip
    assert 1.0 < resistances[0] < resistances[1] < 1.4


def test_a_balance_that_is_none():
    with pytest.raises(ModelError, match="unknown balance 'runs'; choose samples or logs"):
        GASSI(motor(), balance="runs").fit(motor_record(20))
