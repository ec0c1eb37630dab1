"""The sample rate by this computer's clock: late arrivals prove nothing, arrivals ever later do."""

import numpy as np
import pytest

from daq.errors import DeviceError
from daq.run.pace import Pace
from tests.soak import mostly_soak

RATE = 800.0  # Hz, asked for
LINE = 0.001  # s that the quickest block takes

# Of the host: samples of a block, mean extra delay on the line [s], how long it is held up and
# how long it then runs, in the mean [s], and how long it needs for a block [s].
HOSTS = {
    "idle": {"jitter": 0.001},
    "pauses": {"pause": 0.3, "running": 0.2},
    "sample by sample": {"block": 1, "jitter": 0.005},
    "starved": {"pause": 0.3, "running": 0.03},
    "one pause in seconds": {"pause": 0.3, "running": 2.0},
    "long pauses": {"pause": 1.0, "running": 0.3},
    "slow line": {"jitter": 0.02},
    "bad line": {"jitter": 0.06},
    "nearly too slow": {"cost": 0.015, "jitter": 0.01},
}


def arrivals(seed, seconds, share, block=16, jitter=0.003, pause=0.0, running=1.0, cost=0.0):
    """Times [s] at which a host sees samples of a device ``share`` times as fast, and their ticks.

    The line keeps the order of blocks; what came during a pause comes at once behind it.
    """
    rng = np.random.default_rng(seed)
    ticks = np.arange(block - 1, seconds * RATE * share, block).astype(int)
    came = 0.05 + ticks / (RATE * share) + LINE + rng.exponential(jitter, len(ticks))
    came = np.maximum.accumulate(came)
    now, stops, row = 0.0, rng.exponential(running), 0
    while row < len(ticks):
        now = max(now, came[row])
        if pause and now >= stops:
            now = max(now, stops + pause * rng.uniform(0.3, 1.0))
            stops = now + rng.exponential(running)
        last = int(np.searchsorted(came, now, side="right"))
        now += cost * (last - row)
        row = last
        yield now, ticks[row - 1].item()


def refusal(times_and_ticks):
    """When the rate is refused [s], and why; None where it is not."""
    now = 0.0
    pace = Pace(RATE, lambda: now)
    for time, tick in times_and_ticks:
        now = time
        try:
            pace.received(tick)
        except DeviceError as error:
            return time, str(error)
    return None


@pytest.mark.parametrize("seed", mostly_soak(range(15), always=2))
@pytest.mark.parametrize("host", HOSTS)
def test_no_load_of_the_computer_makes_a_right_rate_wrong(host, seed):
    share = (1.0, 0.9998, 1.0002)[seed % 3]  # quartzes
    assert refusal(arrivals(seed, 60.0, share, **HOSTS[host])) is None


@pytest.mark.parametrize("share", [0.97, 0.95, 0.9])
@pytest.mark.parametrize("host", ["idle", "one pause in seconds"])
def test_a_slow_device_is_refused_within_three_seconds(host, share):
    for seed in range(5):
        time, reason = refusal(arrivals(seed, 3.0, share, **HOSTS[host]))
        assert time < 3.0 and "less than 800 Hz" in reason and "too slowly" in reason


@pytest.mark.parametrize("host", [name for name in HOSTS if name != "bad line"])
def test_no_load_hides_a_slow_device_for_long(host):
    assert refusal(arrivals(1, 12.0, 0.95, **HOSTS[host]))


def test_a_rate_that_becomes_slow_is_refused_as_soon():
    before = list(arrivals(0, 20.0, 1.0))
    since, first = before[-1]
    after = [(since + time, first + tick) for time, tick in arrivals(1, 4.0, 0.95)]
    time, _ = refusal([*before, *after])
    assert since < time < since + 4.0


@pytest.mark.parametrize("share", [1.03, 1.1])
def test_a_fast_device_is_refused_as_early_as_it_is_proved(share):
    time, reason = refusal(arrivals(0, 4.0, share, **HOSTS["idle"]))
    assert time < 0.1 / (share - 1.01) + 0.1 and "too fast" in reason
