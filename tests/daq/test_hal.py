"""The HAL's contract on the simulated backend, and what ``Rig`` makes of raw samples."""

import numpy as np
import pytest
from scipy.linalg import expm

from daq.config.rig import RigConfig
from daq.hal import Mode
from daq.rig import Rig
from sim_rig.actuator import actuator
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.hal_contract import RATE, Bench, HalContract, free_currents, levels, plan, play

KINDS = {
    # A converter of 16 bits over 20 V rounds by at most half a step; 10 mV rms of noise and
    # 20 mV of offset are 5 and 10 mA.
    "ideal": ({"ideal": True}, 0.0, 1e-3),
    "noisy": ({"seed": 5}, 1.6e-4, 0.05),
    "real time": ({"seed": 5, "time": "real"}, 1.6e-4, 0.05),
}


def simulated(kind):
    options, resolution, noise = KINDS[kind]
    return Bench(
        name=f"simulated, {kind}",
        make=lambda: SimulatedDevice(Simulation(**options)),
        config=RigConfig(),
        resolution=resolution,
        noise=noise,
    )


def _exact_currents(applied, omega):
    """Currents of both channels by the matrix exponential, from commands and measured speed.

    Written out from the equations of driver and winding, without the project's integrators.
    """
    rig = actuator(parameters="rig")
    p = dict(zip(rig.parameter_names, rig.nominal, strict=True))
    result = np.zeros((len(applied), 2))
    for j, (K, w, R, L, emf) in enumerate(
        [
            (p["K_dm"], p["omega_dm"], p["R_m"], p["L_m"], p["K_m"]),
            (p["K_db"], p["omega_db"], p["R_b"], p["L_b"], 0.0),
        ]
    ):
        # [v, i, u, back_emf] with the last two held over the sample.
        A = np.zeros((4, 4))
        A[0] = [-w, -w * K, w * K * p["K_v2i"], 0.0]
        A[1] = [1.0 / L, -R / L, 0.0, -1.0 / L]
        step = expm(A / RATE)
        state = np.zeros(4)
        between = np.append((omega[1:] + omega[:-1]) / 2.0, omega[-1])
        for k in range(len(applied)):
            result[k, j] = state[1]
            state[2:] = applied[k, j], emf * between[k]
            state = step @ state
    return result


class TestSimulated(HalContract):
    @pytest.fixture(params=list(KINDS))
    def bench(self, request):
        return simulated(request.param)

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents


def _logged(config=None, seed=5, commands=None, **options):
    device = SimulatedDevice(Simulation(seed=seed, **options))
    with Rig(device, config or free_currents(RigConfig())) as rig:
        return play(rig, plan(600, 4) if commands is None else commands)


def test_the_ideal_rig_follows_the_exact_solution_closely():
    played = _logged(ideal=True, commands=np.repeat(plan(60, 3), 10, axis=0) * [0.5, 0.5])
    exact = _exact_currents(played.applied, played.omega)
    error = played.current_brake - exact[:, 1]
    assert np.abs(error).max() < 1e-4 * np.abs(exact[:, 1]).max()


def test_one_seed_gives_the_same_samples_to_the_bit_and_another_does_not():
    one, same, other = _logged(seed=5), _logged(seed=5), _logged(seed=6)
    for name in ("current_motor", "current_brake", "torque", "theta", "omega"):
        assert np.array_equal(getattr(one, name), getattr(same, name)), name
    assert not np.array_equal(one.current_motor, other.current_motor)


def test_chunking_does_not_change_a_single_bit_of_the_samples():
    rigs = [Rig(SimulatedDevice(Simulation(seed=5)), free_currents(RigConfig())) for _ in range(2)]
    logs = []
    for rig, sizes in zip(rigs, (None, [1, 2, 3, 250, 44, 300]), strict=True):
        with rig:
            logs.append(play(rig, plan(600, 4), sizes=sizes))
    for name in vars(logs[0]):
        assert np.array_equal(getattr(logs[0], name), getattr(logs[1], name)), name


@pytest.mark.parametrize("name", ["current_motor", "current_brake", "torque"])
def test_scale_and_sign_of_an_input_act_on_its_column_alone(name):
    base = RigConfig()
    scale = getattr(base.sensors, name).scale
    changed = RigConfig.model_validate({"sensors": {name: {"scale": 2 * scale, "sign": -1}}})
    one, two = _logged(free_currents(base)), _logged(free_currents(changed))
    for column in ("current_motor", "current_brake", "torque", "theta", "omega"):
        factor = -2.0 if column == name else 1.0
        np.testing.assert_allclose(
            getattr(two, column), factor * getattr(one, column), rtol=1e-12, err_msg=column
        )
        assert np.abs(getattr(one, column)).max() > 0.0


def test_sign_and_cycles_of_the_encoder_act_on_angle_and_speed():
    changed = RigConfig.model_validate({"sensors": {"encoder": {"cycles": 1024, "sign": -1}}})
    commands = levels(600, motor=0.8)
    one, two = _logged(commands=commands), _logged(free_currents(changed), commands=commands)
    assert np.abs(one.theta).max() > 0.1
    np.testing.assert_allclose(two.theta, -2.0 * one.theta, rtol=1e-12)
    np.testing.assert_allclose(two.omega, -2.0 * one.omega, rtol=1e-12)


class Guarded(SimulatedDevice):
    """Keeps the guard that it was started with."""

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        self.guard = guard


@pytest.mark.parametrize("sign", [-1, 1])
def test_offsets_do_not_move_the_current_limit(sign):
    # An input that reads 3 V at zero current must still trip at the limit in amperes.
    config = RigConfig.model_validate(
        {
            "limits": {"current": {"motor": 0.3}},
            "sensors": {"current_motor": {"scale": 0.5, "sign": sign}},
        }
    )
    device = Guarded(Simulation())
    with Rig(device, config) as rig:
        rig.offsets = np.array([3.0, 0.0, 0.0])
        rig.start(800.0, Mode.OPEN_LOOP)
    guard = device.guard
    np.testing.assert_allclose([guard.analog_low[0], guard.analog_high[0]], [2.4, 3.6])
    assert np.isinf(guard.analog_high[2]), "torque has no limit"


@pytest.mark.parametrize("sign", [-1, 1])
def test_limits_of_the_shaft_reach_the_device_in_counts(sign):
    config = RigConfig.model_validate(
        {
            "limits": {"speed": "60 rpm", "encoder": {"fastest": 100.0}},
            "sensors": {"encoder": {"cycles": 500, "sign": sign}},
        }
    )
    device = Guarded(Simulation())
    with Rig(device, config) as rig:
        rig.start(800.0, Mode.OPEN_LOOP, (-0.5 * np.pi, np.inf))
    guard = device.guard
    window = (-500.0, np.inf) if sign > 0 else (-np.inf, 500.0)
    np.testing.assert_allclose((guard.counts_low, guard.counts_high), window)
    np.testing.assert_allclose(guard.count_rate, 2000.0)
    np.testing.assert_allclose(guard.count_step, 2000.0 / 800.0 + 2.0)


def test_a_jump_of_the_count_is_watched_without_a_limit_of_speed_too():
    config = RigConfig.model_validate(
        {"limits": {"encoder": {"fastest": 100.0}}, "sensors": {"encoder": {"cycles": 500}}}
    )
    device = Guarded(Simulation())
    with Rig(device, config) as rig:
        rig.start(800.0, Mode.OPEN_LOOP)
    assert np.isinf(device.guard.count_rate)
    np.testing.assert_allclose(device.guard.count_step, 100.0 / 800.0 / (2.0 * np.pi) * 2000.0)
