from __future__ import annotations

import numpy as np
import pytest

from sysid import GASSI, BatchSimulator, Dataset, SearchSpace, guess_ranges


@pytest.fixture
def dc_motor(example):
    return example("dc_motor")


def test_it_is_the_motor_of_section_4_1_4(dc_motor):
    model = dc_motor.model
    assert dict(zip(model.parameter_names, model.nominal, strict=True)) == {
        "resistance": 1.0,
        "inductance": 6e-4,
        "inertia": 8e-7,
        "damping": 1.33e-5,
        "constant": 2.38e-2,
    }
    assert model.output_names == ("current", "omega")
    assert model.input_names == ("voltage", "load")


def test_its_ranges_are_a_decade_either_side(dc_motor):
    space = SearchSpace.of(dc_motor.model)
    np.testing.assert_allclose(space.lower, dc_motor.model.nominal / 10.0)
    np.testing.assert_allclose(space.upper, dc_motor.model.nominal * 10.0)
    assert space.log.all()


def test_its_equations_balance_at_steady_state(dc_motor):
    # With 1 V and no load: K i = B omega and V = R i + K omega.
    R, _L, _J, B, K = dc_motor.model.nominal
    omega = 1.0 / (K + R * B / K)
    x = (B * omega / K, omega)
    rates = dc_motor.model.derivative(x, (1.0, 0.0), tuple(dc_motor.model.nominal))
    np.testing.assert_allclose(np.array(rates) * [6e-4, 8e-7], 0.0, atol=1e-14)


@pytest.mark.soak
def test_simulate_identify_predict(dc_motor):
    t = np.arange(200) * 0.01
    inputs = np.column_stack(
        [np.where(t % 1.0 < 0.5, 1.0, -1.0), 0.01 * np.sin(2 * np.pi * 0.3 * t)]
    )
    blank = Dataset(inputs, np.full((200, 2), np.nan), 0.01)
    model = dc_motor.model
    outputs = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, blank)[0]
    found = GASSI(model, dt=0.01).fit(inputs, outputs)
    assert found.error_ < 1e-4
    assert found.parameters_["resistance"] == pytest.approx(1.0, rel=0.02)
    assert found.score(inputs, outputs) > 0.999


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(5))
def test_what_it_guesses_from_a_noisy_record_holds_the_truth(dc_motor, seed):
    rng = np.random.default_rng(seed)
    model = dc_motor.model
    true = model.nominal * rng.uniform(0.5, 2.0, 5)
    voltage = np.repeat(rng.choice([-1.0, 0.3, 1.0], 40), 10)
    record = Dataset(
        np.column_stack([voltage, 0.005 * np.sin(0.02 * np.arange(400))]),
        np.full((400, 2), np.nan), 0.01, "bench",
    )  # fmt: skip
    outputs = BatchSimulator(model, accuracy=1e-6).trajectories(true, record)[0]
    noisy = outputs + 0.01 * np.abs(outputs).max(axis=0) * rng.normal(size=(400, 2))
    found = guess_ranges(model, [Dataset(record.inputs, noisy, 0.01, "bench")])
    assert set(found) == {"resistance", "constant"}
    for name, guess in found.items():
        assert guess.low < true[model.parameter_names.index(name)] < guess.high
        assert guess.high < 2.0 * guess.low and guess.source.endswith("in bench")
