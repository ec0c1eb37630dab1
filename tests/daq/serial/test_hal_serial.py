"""The HAL's contract on the serial backend: a real process behind a real pty."""

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.errors import DeviceError
from daq.rig import Rig
from daq.serial.backend import SerialDevice, SerialOptions
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
