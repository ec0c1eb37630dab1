"""CEGA's own objective against the equations written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sysid import GASSI, BatchSimulator, Dataset, Input, Output, SearchSpace
from sysid.examples import lag, lag_record
from sysid.gassi.cega_objective import CegaObjective


def written_out(record, simulated, velocity):
    """(4.6) sample by sample."""
    measured, total, n = record.outputs[:, 0], 0.0, 0
    low, high = np.nanmin(velocity), np.nanmax(velocity)
    span = np.nanmax(measured) - np.nanmin(measured)
    for v, y, w in zip(velocity, measured, simulated[:, 0], strict=True):
        if np.isfinite(y):
            total += abs(2.0 * (v - low) / (high - low) - 1.0) * ((w - y) / span) ** 2
            n += 1
    return total / n


@pytest.mark.parametrize("side", ["input", "output", "none"])
def test_the_error_is_4_6(side):
    model, record = lag(), lag_record()
    y = record.outputs.copy()
    y[10] = np.nan
    record = Dataset(record.inputs, y, record.dt)
    velocity = record.inputs[:, 0]
    if side == "input":
        model = replace(model, inputs=(Input("u", "rad/s"),))
    if side == "output":
        model, velocity = replace(model, outputs=(Output("y", "m/s"),)), record.outputs[:, 0]
    chromosomes = np.array([[2.0, 0.05], [3.5, 0.02], [1.0, 0.4]])
    simulator = BatchSimulator(model, accuracy=1e-6)
    objective = CegaObjective(simulator, SearchSpace.of(model), [record])
    errors, _ = objective.evaluate(chromosomes)
    for chromosome, error in zip(chromosomes, errors, strict=True):
        run = simulator.trajectories(chromosome[None], record, 8)[0]
        expected = written_out(record, run, velocity)
        if side == "none":
            span = np.ptp(y[np.isfinite(y)])
            expected = np.nanmean(((run - y) / span) ** 2)
        assert_allclose(error, expected, rtol=1e-4)


def test_the_preset_minimises_it():
    model, record = replace(lag(), inputs=(Input("u", "rad/s"),)), lag_record()
    found = GASSI(model, preset="cega", population=40, generations=20).fit(record)
    run = found.predict(record)
    assert_allclose(found.error_, written_out(record, run, record.inputs[:, 0]), rtol=1e-2)
    thesis = GASSI(model, preset="thesis", population=40, generations=20).fit(record)
    assert thesis.error_ > 5.0 * found.error_  # a root there, squares here
