"""Outputs that were logged in another unit are named with it."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.gassi import GASSI
from sysid.judging.examination import suspected, verdict_of
from sysid.judging.mistaken_units import output_in_another_unit
from tests.soak import mostly_soak
from tests.sysid.test_latencies import MOTOR, TRUTH, log
from tests.sysid.test_missing_physics import BODY, STIFF, body_log, shaft_log


@pytest.mark.parametrize(
    ("unit", "times"), mostly_soak([("rpm", 9.5493), ("deg/s", 57.2958)], always=1)
)
def test_a_speed_in_another_unit_is_named_with_it(unit, times):
    """Where parameters cannot make up for it: in wider ranges K, J and B do, and no log tells."""
    training, validation = (
        replace(record, outputs=record.outputs * [1.0, times])
        for record in (log(0.0, 1), log(0.0, 2))
    )
    estimator = GASSI(MOTOR, population=60, generations=14).fit(training)
    verdict = verdict_of(estimator, [training], [validation])
    (reason,) = [r for r in verdict.parameters.reasons if "times what" in r]
    assert reason.startswith(f"w is {times:.3g} times what the model has, as in {unit} (p < 1e-9)")
    uncertainty = estimator.uncertainty(training)
    (finding,) = suspected(estimator, uncertainty, [training]).findings
    for move in finding.moves:
        if move.quantity.name in TRUTH:
            right = move.quantity.value + move.change
            assert right == pytest.approx(TRUTH[move.quantity.name], rel=0.05)


@pytest.mark.soak
def test_a_temperature_in_fahrenheit_has_another_zero_as_well():
    warm = body_log(1, 0.0)
    fahrenheit = replace(warm, outputs=1.8 * (warm.outputs + 20.0) + 32.0)
    degrees = [replace(signal, unit="degC") for signal in BODY.outputs]
    model = replace(
        BODY,
        states=tuple(
            replace(s, initial=20.0, unit="degC", first_sample=False) for s in BODY.states
        ),
        outputs=tuple(degrees),
        derivative=lambda x, u, p: BODY.derivative((x[0] - 20.0, x[1] - 20.0), u, p),
    )
    outputs = np.column_stack([fahrenheit.outputs[:, 0], warm.outputs[:, 1] + 20.0])
    record = replace(fahrenheit, outputs=outputs)
    estimator = GASSI(model, population=60, generations=14).fit(record)
    findings = output_in_another_unit(estimator, estimator.uncertainty(record), [record])
    named = [(f.kind, f.name, f.unit, f.amplitude) for f in findings]
    assert named == [
        ("gain", "inside", "degF", pytest.approx(0.8)),
        ("offset", "inside", "degC", 32.0),
    ]


def test_what_is_poorly_explained_for_another_reason_is_in_its_unit():
    record = shaft_log(1, 0.0, seen=(1,))
    estimator = GASSI(STIFF, population=30, generations=8).fit(record)
    assert output_in_another_unit(estimator, estimator.uncertainty(record), [record]) == ()
