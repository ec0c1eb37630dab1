"""The firmware's ELF in QEMU in real time on a pty, by ``rig emulate --firmware``.

A busy machine keeps QEMU waiting, now and then for longer than the protocol allows. What fails is
tried again if, and only if, QEMU was late meanwhile by its own clock (``patience``).
"""

import pytest

from daq.config.rig import RigConfig
from daq.serial.backend import SerialDevice, SerialOptions
from tests.daq.hal_contract import Bench, HalContract
from tests.daq.serial.support import emulator
from tests.daq.test_hal import _exact_currents
from tests.firmware import lockstep, patience
from tests.firmware.build import needs

RESOLUTION, NOISE = 1.6e-4, 0.05
WATCHDOG = 2.0  # s


@pytest.fixture(scope="module")
def elf():
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    return lockstep.elf()


@pytest.fixture(scope="module")
def port(elf, tmp_path_factory):
    with emulated(elf, tmp_path_factory.mktemp("qemu"), seed=5) as running:
        patience.watch(running)
        yield running.port


def emulated(elf, folder, **plant):
    return emulator(folder, "--firmware", elf, plant=plant)


@pytest.mark.soak
@pytest.mark.patient
class TestFirmware(HalContract):
    @pytest.fixture
    def bench(self, port):
        return Bench(
            name=f"firmware in QEMU on {port}",
            make=lambda: SerialDevice(SerialOptions(port=port, watchdog=WATCHDOG)),
            config=RigConfig(),
            resolution=RESOLUTION,
            noise=NOISE,
        )

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents
