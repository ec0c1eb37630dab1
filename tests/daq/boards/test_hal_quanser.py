"""The HAL's contract on a Quanser card: a fake one, for no test has met hardware."""

import pytest

from daq.config.rig import RigConfig
from tests.daq.boards.support import fakes, quanser
from tests.daq.hal_contract import Bench, HalContract
from tests.daq.test_hal import _exact_currents

# What a card that plays by itself cannot do.
NO_REACTION = "a card that plays a waveform by itself watches no limit: zeros come a block later"
LATER = {
    "test_a_current_beyond_its_limit_zeroes_the_outputs_from_that_row_on[open loop]",
}


def bench_of(playback):
    return Bench(
        name=f"Quanser, played by the {playback}",
        make=lambda: quanser(playback=playback),
        config=RigConfig(),
        resolution=3.1e-4,
        noise=0.05,
    )


class TestPlayedByHost(HalContract):
    """All of the contract."""

    @pytest.fixture
    def bench(self):
        with fakes():
            yield bench_of("host")

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents


class TestPlayedByBoard(TestPlayedByHost):
    @pytest.fixture
    def bench(self):
        with fakes():
            yield bench_of("board")
