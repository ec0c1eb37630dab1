"""The serial rig: speed of its codec, frames that must not pass, samples over a pty, dead hosts.

    python -m benchmarks.serial [--samples 80000] [--fuzz 200000] [--kills 5] [--json]

The bars: a million samples at 4 kHz over the pty (``--samples 1000000``, four minutes), none lost,
the host under 15 % of a core; 3 million samples/s through the codec in blocks; 10 million mutated
frames (``--fuzz 10000000``), none accepted that was not sent; outputs at zero within the watchdog's
time (0.1 s) after the host was killed. Emulator and host are processes of their own.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from daq.hal import Flag
from daq.logs.recording import load
from daq.serial import codec, messages
from daq.serial.codec import Decoder
from daq.serial.messages import Block, Latch, State, Status, Type

RIG = (sys.executable, "-m", "daq.cli")
RATE = 4000.0  # Hz
_REPEATS = 100
_STATUS = Status(1, State.RUNNING, Latch.NONE, 0, 0, 0, 0, 0)
_EXPERIMENT = """
protocol: prbs
sample_rate: {rate:g}
duration: {seconds}
calibration: {{samples: 400}}
motor: {{amplitude: 0.3, offset: 0.0, minimum_period: 0.01, seed: 4}}
brake: {{amplitude: 0.07, offset: 0.07, minimum_period: 0.05, seed: 5}}
"""
_PLANT = "{backend: simulated, options: {plant: {load: free}}}\n"


def codec_speed(block: int, samples: int) -> dict[str, float]:
    """Samples per second into frames, and out of a stream of them, in blocks of so many."""
    rng = np.random.default_rng(0)
    records = np.zeros(block, messages.SAMPLE_DTYPE)
    records["analog"] = rng.integers(-30_000, 30_000, (block, 3))
    records["counts"] = rng.integers(0, 100_000, block)
    records["applied"] = rng.integers(-16_384, 16_384, (block, 2))
    blocks = max(1, samples // block)

    def encode() -> list[bytes]:
        return [
            codec.encode(Type.SAMPLES, 7, k, Block(_STATUS, k * block, 0, records).pack())
            for k in range(blocks)
        ]

    def decode() -> int:
        decoder, n = Decoder(), 0
        # As the host reads: what 20 ms bring, made into volts.
        for frame in frames:
            parts = [Block.unpack(item.payload) for item in decoder.feed(frame)]
            records = messages.joined(parts)
            n += len(records["analog"] * 3e-4)
        return n

    # The best of many short ones: on a busy machine the others measure its other programs.
    took, frames = min((_common.timed(encode) for _ in range(_REPEATS)), key=lambda pair: pair[0])
    took_back, n = min(_common.timed(decode) for _ in range(_REPEATS))
    assert n == blocks * block
    return {"encoded_per_second": n / took, "decoded_per_second": n / took_back}


def fuzz(frames: int, seed: int) -> dict[str, int]:
    """Frames damaged in every way a line can; how many came out that had not gone in."""
    rng = np.random.default_rng(seed)
    pool = [
        codec.encode(int(rng.integers(1, 160)), 7, k, rng.bytes(int(rng.integers(0, 120))))[1:-1]
        for k in range(512)
    ]
    sent = {codec.decode(coded) for coded in pool}
    tried = accepted = wrong = 0
    while tried < frames:
        n = min(65_536, frames - tried)
        draws = rng.integers(0, 2**31, (n, 6)).tolist()
        noise = rng.bytes(4096)
        for which, kind, a, b, c, d in draws:
            damaged = _damage(pool[which % 512], pool[d % 512], kind % 6, a, b, c, noise)
            frame = codec.decode(damaged)
            if frame is not None:
                accepted += 1
                wrong += frame not in sent
        tried += n
    return {"mutated_frames": tried, "unharmed": accepted, "wrongly_accepted": wrong}


def _damage(coded: bytes, other: bytes, kind: int, a: int, b: int, c: int, noise: bytes) -> bytes:
    at, to = a % len(coded), b % len(coded)
    if kind == 0:  # one to three bits turned
        damaged = bytearray(coded)
        for place, bit in ((a, b), (b, c), (c, a))[: 1 + c % 3]:
            damaged[place % len(coded)] ^= 1 << bit % 8
        return bytes(damaged)
    if kind == 1:  # a burst
        length = 1 + b % 12
        return coded[:at] + noise[c % 4000 : c % 4000 + length] + coded[at + length :]
    if kind == 2:  # bytes lost
        return coded[: min(at, to)] + coded[max(at, to) + 1 :]
    if kind == 3:  # bytes that came from nowhere
        return coded[:at] + noise[c % 4000 : c % 4000 + 1 + b % 12] + coded[at:]
    if kind == 4:  # two frames run into one
        return coded[:at] + other[b % len(other) :]
    return coded[:at] + bytes([c % 256]) + coded[at + 1 :]  # a byte changed


@contextlib.contextmanager
def emulator(folder: Path) -> Iterator[tuple[str, int]]:
    """A ``rig emulate`` process in a folder: its port and process number."""
    (folder / "plant.yaml").write_text(_PLANT)
    process = subprocess.Popen(
        [*RIG, "emulate", "--json", "--rig", "plant.yaml", "--journal", "journal.jsonl",
         "--link", str(folder / "port")],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        said = ""
        while "}" not in said:
            said += process.stdout.readline()
        yield json.loads(said)["port"], process.pid
    finally:
        process.terminate()
        process.wait()


def start_run(folder: Path, port: str, samples: int) -> subprocess.Popen[str]:
    """A ``rig run`` of so many samples at 4 kHz."""
    (folder / "e.yaml").write_text(_EXPERIMENT.format(rate=RATE, seconds=samples / RATE))
    return subprocess.Popen(
        [*RIG, "run", "e.yaml", "--rig", "serial.yaml", "--port", port, "--json"],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def over_the_pty(folder: Path, samples: int) -> dict[str, Any]:
    """A run at 4 kHz: what was lost, and what both processes took of a core."""
    with emulator(folder) as (port, emulator_pid):
        before = _processor_seconds(emulator_pid)
        process = start_run(folder, port, samples)
        begun, used, memory = time.perf_counter(), 0.0, []
        while process.poll() is None:
            memory.append((_resident(process.pid), _resident(emulator_pid)))
            used = max(used, _processor_seconds(process.pid))
            time.sleep(1.0)
        wall = time.perf_counter() - begun
        emulated = _processor_seconds(emulator_pid) - before
    run = next((folder / "runs").iterdir())
    import pandas  # noqa: F401  # what a program that loads logs has imported by then

    took, recording = _common.timed(lambda: load(run))
    flags = recording.frame["flags"].to_numpy()
    quarter = memory[len(memory) // 4 : -1] or memory
    return {
        "samples": len(flags),
        "asked": samples,
        "flagged_lost": int(np.count_nonzero(flags & int(Flag.LOST))),
        "status": (recording.record or {}).get("status"),
        "reason": (recording.record or {}).get("reason"),
        "wall_seconds": wall,
        "host_share_of_a_core": used / wall,
        "emulator_share_of_a_core": emulated / wall,
        "host_memory_growth_kb": quarter[-1][0] - quarter[0][0],
        "emulator_memory_growth_kb": quarter[-1][1] - quarter[0][1],
        "log_loads_in_seconds": took,
    }


def kills(folder: Path, n: int, seed: int) -> list[float]:
    """``kill -9`` of hosts in mid run; the silence after which the outputs were zero [s]."""
    rng = np.random.default_rng(seed)
    silences = []
    for k in range(n):
        place = folder / f"kill{k}"
        place.mkdir()
        with emulator(place) as (port, _):
            process = start_run(place, port, 400_000)
            _journal_until(place, lambda entry: any(entry["outputs"]))
            time.sleep(float(rng.uniform(0.0, 0.5)))
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            entry = _journal_until(place, lambda entry: entry["latch"] == "WATCHDOG")
            silences.append(entry["silence_seconds"])
            assert not any(entry["outputs"])
    return silences


def _journal_until(folder: Path, wanted: Any) -> dict[str, Any]:
    deadline = time.perf_counter() + 30.0
    while time.perf_counter() < deadline:
        lines = (folder / "journal.jsonl").read_text().splitlines()
        for entry in map(json.loads, lines):
            if wanted(entry):
                return dict(entry)
        time.sleep(0.01)
    raise RuntimeError(f"{folder}: the emulator's journal has no such entry")


def _processor_seconds(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> int:
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return int(text.split("VmRSS:")[1].split()[0]) if "VmRSS:" in text else 0


def main() -> None:
    """Command line."""
    parser = _common.arguments("the serial rig")
    parser.add_argument("--samples", type=int, default=80_000)
    parser.add_argument("--fuzz", type=int, default=200_000)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    _common.report(measure(chosen), chosen.json, show)


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """Everything that was asked for."""
    figures: dict[str, Any] = {
        "codec": {str(block): codec_speed(block, 200 * block) for block in (1, 16, 80, 144)},
        "fuzz": fuzz(chosen.fuzz, chosen.seed),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if chosen.samples:
            figures["pty"] = over_the_pty(folder, chosen.samples)
        figures["silence_until_zero_seconds"] = kills(folder, chosen.kills, chosen.seed)
    return figures


def show(figures: dict[str, Any]) -> None:
    print("Codec, millions of samples per second:")
    for block, speed in figures["codec"].items():
        print(
            f"  blocks of {block:>3}: {speed['encoded_per_second'] / 1e6:6.2f} encoded, "
            f"{speed['decoded_per_second'] / 1e6:6.2f} decoded"
        )
    fuzzed = figures["fuzz"]
    print(
        f"{fuzzed['mutated_frames']} mutated frames: {fuzzed['wrongly_accepted']} wrongly accepted "
        f"({fuzzed['unharmed']} came out as they were sent)"
    )
    if "pty" in figures:
        pty = figures["pty"]
        print(
            f"{pty['samples']} of {pty['asked']} samples at {RATE:g} Hz over a pty "
            f"({pty['status']}), {pty['flagged_lost']} gaps; host "
            f"{100 * pty['host_share_of_a_core']:.1f} % of a core, emulator "
            f"{100 * pty['emulator_share_of_a_core']:.1f} %; memory grew by "
            f"{pty['host_memory_growth_kb']} and {pty['emulator_memory_growth_kb']} kB; the log "
            f"loads in {pty['log_loads_in_seconds']:.2f} s"
        )
        if pty["reason"]:
            print(f"  {pty['reason']}")
    silences = figures["silence_until_zero_seconds"]
    if silences:
        print(
            f"{len(silences)} hosts killed: outputs zero after at most "
            f"{1e3 * max(silences):.1f} ms of silence"
        )


if __name__ == "__main__":
    main()
