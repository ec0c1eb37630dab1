"""The HAL's contract on the serial backend: a real process behind a real pty."""

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.errors import DeviceError
from daq.rig import Rig
from daq.serial.backend import SerialDevice, SerialOptions
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.hal_contract import Bench, HalContract, free_currents, plan, play
from tests.daq.serial.support import emulator
from tests.daq.test_hal import _exact_currents

# Half a step of a converter of 16 bits over 20 V; noise and offsets as in test_hal.
RESOLUTION, NOISE = 1.6e-4, 0.05
# A busy machine may not let this process run for longer than the default of 0.1 s.
WATCHDOG = 1.0


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    with emulator(tmp_path_factory.mktemp("hal"), plant={"seed": 5}) as running:
        yield running.port


class TestSerial(HalContract):
    @pytest.fixture
    def bench(self, port):
        return Bench(
            name=f"serial over {port}",
            make=lambda: SerialDevice(SerialOptions(port=port, watchdog=WATCHDOG)),
            config=RigConfig(),
            resolution=RESOLUTION,
            noise=NOISE,
        )

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents


@pytest.mark.soak
def test_a_tcp_port_carries_the_same(tmp_path):
    commands = plan(400, 3)
    with emulator(tmp_path, "--tcp", "0", plant={"seed": 5}) as running:
        device = SerialDevice(SerialOptions(port=running.port, watchdog=WATCHDOG))
        assert running.port.startswith("socket://127.0.0.1:")
        for _ in range(3):  # closed and opened again at once
            with Rig(device, free_currents(RigConfig())) as rig:
                played = play(rig, commands)
        second = SerialDevice(SerialOptions(port=running.port))
        with Rig(device, RigConfig()), pytest.raises(DeviceError, match="one program at a time"):
            second.open()
    np.testing.assert_allclose(played.applied, commands, atol=RESOLUTION)
    assert not played.flags.any()


@pytest.mark.soak
def test_the_wire_adds_nothing_to_the_samples(tmp_path):
    # Without noise, and with commands that the converters have, the same rig gives the same.
    codes = np.random.default_rng(8).integers([-3000, 0], [3000, 1000], (60, 2))
    commands = np.repeat(codes * (20.0 / 65536), 10, axis=0)
    config = free_currents(RigConfig())
    with Rig(SimulatedDevice(Simulation(ideal=True)), config) as rig:
        here = play(rig, commands)
    with emulator(tmp_path, plant={"ideal": True}) as running:
        device = SerialDevice(SerialOptions(port=running.port, watchdog=WATCHDOG))
        with Rig(device, config) as rig:
            there = play(rig, commands)
    assert np.array_equal(there.tick, here.tick)
    assert np.array_equal(there.applied, here.applied)
    # Half a step of 24 bits over 20 V, in amperes and newton metres; half a count; float32.
    for name, step in (("current_motor", 0.5), ("current_brake", 0.5), ("torque", 0.706)):
        error = getattr(there, name) - getattr(here, name)
        assert np.abs(error).max() < 1.01 * step * 10.0 / 2**24, name
    assert np.abs(there.theta - here.theta).max() < 1.01 * np.pi / 8192
    np.testing.assert_allclose(there.omega, here.omega, rtol=1e-6, atol=1e-9)
