"""The firmware's core beside the Python device, on as many random sequences as one likes.

    python -m benchmarks.firmware [--sequences 1000000] [--first 0] [--frames 10000000]
        [--workers 2] [--json]

Sequences of bytes, waits and inputs are played to both (tests/firmware/sequences.py), the firmware
built for this computer under the address and the undefined-behaviour sanitizer. What is compared
after every event: each answer, what every tick applied, samples, state, latch and outputs. Frames
are damaged in C and fed to the decoder, which may accept none.
"""

from __future__ import annotations

import json
import subprocess
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks._common import arguments, report, timed
from tests.firmware.build import make
from tests.firmware.sequences import Author, Firmware, difference

_SHARE = 1000  # sequences of a task


def play(program: Path, first: int) -> tuple[int, list[str]]:
    """Sequences from number ``first`` on: events played, and differences."""
    firmware = Firmware(program)
    events, differences = 0, []
    for seed in range(first, first + _SHARE):
        sequence = Author(seed).sequence()
        events += len(sequence)
        if problem := difference(sequence, firmware):
            differences.append(f"sequence {seed}: {problem}")
    firmware.close()
    return events, differences


def fuzz(program: Path, frames: int, seed: int) -> dict[str, int]:
    """Counts of what the decoder did."""
    words = [program, str(frames), str(seed)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    counts: dict[str, int] = json.loads(done.stdout)
    return counts


def measure(first: int, sequences: int, frames: int, workers: int) -> dict[str, Any]:
    """All of it, in processes."""
    folder = make("native") / "native"
    shares = range(first, first + sequences, _SHARE)
    with ProcessPoolExecutor(workers) as pool:
        seconds, results = timed(
            lambda: list(pool.map(play, [folder / "replay"] * len(shares), shares))
        )
        part = frames // workers
        fuzzed, counts = timed(
            lambda: list(
                pool.map(fuzz, [folder / "fuzz"] * workers, [part] * workers, range(1, workers + 1))
            )
        )
    return {
        "sequences": len(shares) * _SHARE,
        "events": sum(events for events, _ in results),
        "differences": [problem for _, problems in results for problem in problems],
        "seconds": seconds,
        "damaged_frames": sum(c["frames"] - c["whole"] for c in counts),
        "accepted": sum(c["accepted"] for c in counts),
        "the_same_otherwise_written": sum(c["same"] for c in counts),
        "fuzz_seconds": fuzzed,
    }


def show(figures: dict[str, Any]) -> None:
    print(
        f"{figures['sequences']} sequences, {figures['events']} events, "
        f"{len(figures['differences'])} differences, in {figures['seconds']:.0f} s"
    )
    for problem in figures["differences"][:10]:
        print(problem[:400])
    print(
        f"{figures['damaged_frames']} damaged frames, {figures['accepted']} accepted, "
        f"{figures['the_same_otherwise_written']} that say the same otherwise, "
        f"in {figures['fuzz_seconds']:.0f} s"
    )


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--sequences", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first sequence")
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    options = parser.parse_args()
    figures = measure(options.first, options.sequences, options.frames, options.workers)
    report(figures, options.json, show)


if __name__ == "__main__":
    main()
