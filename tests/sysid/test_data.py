from __future__ import annotations

import numpy as np
import pytest

from sysid import GASSI, Dataset, ModelError, output_scale
from tests.sysid.support import lag, motor


def test_columns_may_be_vectors():
    data = Dataset(np.zeros(5), np.ones(5), 0.1)
    assert data.inputs.shape == data.outputs.shape == (5, 1)
    assert data.n_samples == 5
    assert np.allclose(data.time, [0.0, 0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize(
    ("inputs", "outputs", "dt", "message"),
    [
        (np.zeros(4), np.zeros(5), 0.1, "4 rows of inputs, 5 of outputs"),
        (np.zeros(1), np.zeros(1), 0.1, "at least 2"),
        (np.zeros(3), np.zeros(3), 0.0, "must be positive"),
        (np.zeros(3), np.zeros(3), np.nan, "must be positive"),
        (np.array([0.0, np.nan, 0.0]), np.zeros(3), 0.1, "input 0 is not finite in row 1"),
        (np.zeros(3), np.array([0.0, 0.0, -np.inf]), 0.1, "output 0 is not finite in row 2.* NaN"),
        (np.zeros(3), np.array([0.0, -1e200, 0.0]), 0.1, "output 0 is beyond 1e100 in row 1"),
        (np.zeros(3) + 1j, np.zeros(3), 0.1, "inputs are complex; give real numbers"),
        (np.zeros(3), np.zeros(3) + 1j, 0.1, "outputs are complex; give real numbers"),
        (np.array(["0", "x", "1"]), np.zeros(3), 0.1, "inputs are not numbers: .*'x'"),
        (np.zeros((3, 1, 1)), np.zeros(3), 0.1, r"inputs have shape \(3, 1, 1\)"),
    ],
)
def test_bad_records(inputs, outputs, dt, message):
    with pytest.raises(ModelError, match=message):
        Dataset(inputs, outputs, dt)


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_an_output_that_never_changes_explains_nothing(value):
    record = Dataset(np.arange(50.0), np.full(50, value), 0.1, "still")
    with pytest.raises(ModelError, match=f"still: y is {value:g} throughout, .* no deviation"):
        GASSI(lag(), population=10, generations=1).fit(record)


def test_constant_outputs_of_several_records_explain_what_differs():
    levels = [Dataset(np.full(9, u), np.full(9, 2.0 * u), 1.0, f"at {u}") for u in (1.0, 2.0)]
    result = GASSI(lag(), population=20, generations=4).fit(levels)
    assert np.isfinite(result.error_)


def test_a_record_shorter_than_what_is_sought_determines_nothing():
    record = Dataset(np.ones(2), np.array([0.0, 1.0]), 0.1, "short")
    wrong = "short: too short: after its first sample it has 1 measured value, for 2 unknowns"
    with pytest.raises(ModelError, match=wrong):
        GASSI(lag(), population=10, generations=1).fit(record)


def test_columns_are_checked_against_the_model():
    with pytest.raises(ModelError, match=r"1 inputs and 1 outputs.*motor has 2 and 2"):
        Dataset(np.zeros(5), np.zeros(5), 0.1).check(motor())


def test_a_run_starts_from_the_first_measured_row_and_else_as_declared():
    model = motor()
    outputs = np.zeros((3, 2))
    outputs[0] = [0.7, np.nan]
    assert Dataset(np.zeros((3, 2)), outputs, 0.1).initial_state(model).tolist() == [0.7, 0.0]
    assert Dataset(np.zeros(3), np.array([4.0, 0, 0]), 0.1).initial_state(lag()).tolist() == [4.0]


def test_output_scale_is_the_largest_magnitude_over_all_records_or_each():
    a = Dataset(np.zeros(3), np.array([[1.0, 0.0, 2.0], [-3.0, 0.0, np.nan], [0, 0, 1.0]]), 0.1)
    b = Dataset(np.zeros(2), np.array([[2.0, 0.0, np.nan], [-1.0, 0.0, np.nan]]), 0.2)
    together = output_scale([a, b])
    assert [scale.tolist() for scale in together] == [[3.0, 1.0, 2.0]] * 2
    each = output_scale([a, b], per_log=True)
    assert [scale.tolist() for scale in each] == [[3.0, 1.0, 2.0], [2.0, 1.0, 1.0]]


def test_a_part_is_a_record_of_its_own():
    whole = Dataset(np.arange(6.0), np.arange(6.0) + 0.5, 0.1, input_noise=[0.2])
    part = whole.part(2, 5, "middle")
    assert (part.name, part.dt, part.n_samples) == ("middle", 0.1, 3)
    assert part.inputs.ravel().tolist() == [2.0, 3.0, 4.0]
    assert part.outputs.ravel().tolist() == [2.5, 3.5, 4.5]
    assert part.input_noise.tolist() == [0.2]
