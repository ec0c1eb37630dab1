"""The independent device itself: it keeps the contract, and without a fault it runs everything."""

import pytest

from daq.config.rig import RigConfig
from tests.daq.hal_contract import Bench, HalContract
from tests.faults.device import Options, VirtualDevice


class TestVirtualDevice(HalContract):
    @pytest.fixture
    def bench(self):
        return Bench(
            name="the independent device",
            make=lambda: VirtualDevice(Options(noise=0.0, offset=0.0)),
            config=RigConfig(),
            resolution=2e-4,
            noise=1e-3,
            step=0.3,
        )
