"""``kill -9`` during a run: every log loads, says so, and lacks next to nothing."""

import sys

import pytest

from benchmarks.kill import instants, kill_many

SEED = 7
LATE = 0.25  # s


@pytest.mark.soak
@pytest.mark.skipif(sys.platform == "win32", reason="there is no kill -9")
def test_a_killed_run_leaves_a_log_that_loads_and_lacks_only_its_last_moment(tmp_path):
    afters = instants(4, SEED)
    print("seed", SEED, "instants", afters)
    for kill in kill_many(tmp_path, afters, at_once=2):
        print(kill)
        assert kill.loaded and kill.error is None
        assert kill.named_interrupted
        # What a sample waits for is the run loop, or a processor on a busy machine; only the
        # first is this program's.
        assert kill.lost <= LATE + kill.starved
