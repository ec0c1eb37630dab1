"""The HAL's contract on cards of other makers: fake ones, for no test has met hardware."""

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.hal import Flag, Guard, Mode
from daq.rig import Rig
from tests.daq.boards.support import fakes, nidaqmx, quanser
from tests.daq.hal_contract import RATE, Bench, HalContract, Played, collect, guard_of, levels
from tests.daq.test_hal import _exact_currents

# A card that plays a waveform by itself watches no limit: zeros come a block of samples later.
# What it does instead is the test at the end.
_SHAFT = "test_a_shaft_beyond_a_limit_zeroes_the_outputs_from_that_row_on"
LATER = {
    "test_a_current_beyond_its_limit_zeroes_the_outputs_from_that_row_on[Mode.OPEN_LOOP]",
    *(f"{_SHAFT}[{what}-Mode.OPEN_LOOP]" for what in ("speed", "travel", "jump")),
    "test_travel_is_counted_from_the_first_sample_of_each_start",
}
CARDS = {"quanser": quanser, "nidaqmx": nidaqmx}


def bench_of(card, playback):
    return Bench(
        name=f"{card}, played by the {playback}",
        make=lambda: CARDS[card](playback=playback),
        config=RigConfig(),
        resolution=3.1e-4,
        noise=0.05,
    )


class TestPlayedByHost(HalContract):
    """All of the contract."""

    @pytest.fixture(params=["quanser", pytest.param("nidaqmx", marks=pytest.mark.soak)])
    def bench(self, request):
        with fakes():
            yield bench_of(request.param, "host")

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents


class TestPlayedByBoard(HalContract):
    """All of it but ``LATER``."""

    @pytest.fixture(params=[pytest.param("quanser", marks=pytest.mark.soak), "nidaqmx"])
    def bench(self, request):
        name = request.node.name.replace(f"{request.param}-", "").replace(f"[{request.param}]", "")
        if name in LATER:
            request.applymarker(pytest.mark.xfail(strict=True, reason="zeros come a block later"))
        with fakes():
            yield bench_of(request.param, "board")

    @pytest.fixture
    def actuator_currents(self):
        return _exact_currents

    @pytest.mark.parametrize("limit", ["current", "speed", "travel", "jump"])
    def test_beyond_a_limit_zeros_follow_within_a_block(self, device, limit):
        wide = guard_of()
        low, high = wide.command_low, wide.command_high
        analog = np.array([0.3, 1e9, 1e9]) if limit == "current" else wide.analog_high
        bounds = {
            "current": {},
            "speed": {"count_rate": 4000.0},
            "travel": {"counts_low": -400.0, "counts_high": 400.0},
            "jump": {"count_step": 5.0},
        }[limit]
        guard = Guard(low, high, -analog, analog, **bounds)
        device.open()
        device.start(RATE, Mode.OPEN_LOOP, guard)
        device.send(0, levels(600, motor=1.0))
        blocks = [device.receive() for _ in range(50)]
        tick, flags, applied, analog, counts, rates = (
            np.concatenate([getattr(block, name) for block in blocks])
            for name in ("tick", "flags", "applied", "analog", "counts", "count_rate")
        )
        assert np.array_equal(tick, np.arange(len(tick)))
        within = {
            "current": np.abs(analog[:, 0]) <= 0.3,
            "speed": np.abs(rates) <= 4000.0,
            "travel": np.abs(counts - counts[0]) <= 400.0,
            "jump": np.abs(np.diff(counts, prepend=counts[0])) <= 5.0,
        }[limit]
        beyond = int(np.argmin(within))
        (row,) = np.flatnonzero(flags & int(Flag.INTERLOCK))
        assert beyond < row <= beyond + 8  # 10 ms
        # The log tells what was applied until then: no row claims zeros that were not there.
        assert (applied[:row] == levels(row, motor=1.0)).all() and not applied[row:].any()
        device.send(600, levels(100, motor=1.0))
        assert not any(device.receive().applied.any() for _ in range(8))

    def test_what_is_logged_as_applied_is_what_the_outputs_did(self, bench, device):
        import bench_world

        rig = Rig(device, bench.config)
        rig.open()
        commands = np.repeat(np.random.default_rng(2).uniform(0.0, 0.3, (60, 2)), 5, axis=0)
        rig.start(RATE, Mode.OPEN_LOOP)
        rig.send(0, commands)
        played = Played(collect(rig, 300))
        (world,) = bench_world._worlds.values()
        volts = np.array([volts for _, volts in world.history])
        changed = np.flatnonzero(np.diff(volts[:, 0], prepend=0.0))
        # 60 levels, then zeros because nothing follows, and no change besides.
        assert np.array_equal(volts[changed], [*commands[::5], [0.0, 0.0]])
        assert np.array_equal(played.applied[:300], commands)
