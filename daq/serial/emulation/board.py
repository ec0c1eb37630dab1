"""A simulated rig as a board behind the wire: its converters, its counter and its identity."""

import numpy as np

from daq.hal import ANALOG_INPUTS, CHANNELS, Electronics, Guard, Mode, Phase, Simulation
from daq.serial import messages
from daq.serial.messages import Channel, CodedGuard, Codes, Records, Welcome

_CLOCK = 48_000_000  # Hz, of a microcontroller with USB
_QUEUE = 16_384  # commands; 64 KiB of its memory
_LARGEST_BLOCK = 256  # ticks that the simulated rig computes at once


class SimulatedBoard:
    """A simulated rig as ``machine.Board``. Its time is the machine's: it plays ticks on request.

    watched: whether the guard's limits of the counter act. phase: of the run. outputs: codes that
    both have. stuck: whether the counter stands still.
    """

    def __init__(self, electronics: Electronics, watched: bool = True) -> None:
        self.phase = Phase.OPEN
        self.outputs = [0] * len(CHANNELS)
        self.stuck = False
        self._electronics = electronics
        self._device = electronics.device
        self._watched = watched
        self._tick = self._count = 0

    def connect(self) -> None:
        """The rig as it stands when somebody switches it on, its load let down."""
        self.phase = Phase.OPEN
        self._device.open()

    def announce(self, phase: int, turns: float) -> None:
        """The simulated user winds the handle when asked to."""
        phases = list(Phase)
        if phase < len(phases):
            self.phase = phases[phase]
            self._device.announce(self.phase, turns)

    def start(self, rate: float, guard: CodedGuard) -> None:
        """Sampling from tick 0 on."""
        step_in, step_out = self._electronics.step_in, self._electronics.step_out
        counts = (guard.counts_low, guard.counts_high, guard.count_rate, guard.count_step)
        volts = Guard(
            np.array(guard.command_low) * step_out,
            np.array(guard.command_high) * step_out,
            np.array(guard.analog_low) * step_in,
            np.array(guard.analog_high) * step_in,
            *(counts if self._watched else ()),
        )
        # Each tick comes with its command: missing ones are the machine's matter.
        self._device.start(rate, Mode.CLOSED_LOOP, volts)
        self._tick = 0

    def play(self, commands: Codes) -> Records:
        """Simulate n ticks."""
        records = np.zeros(len(commands), dtype=messages.SAMPLE_DTYPE)
        for at in range(0, len(commands), _LARGEST_BLOCK):
            part = slice(at, at + _LARGEST_BLOCK)
            self._play(commands[part], records[part])
        if self.stuck:
            records["counts"], records["count_rate"] = self._count, 0.0
        self._count = int(records["counts"][-1])
        self.outputs = records["applied"][-1].tolist()
        return records

    def zero(self) -> None:
        """Outputs to zero until the next start."""
        self.outputs = [0] * len(CHANNELS)
        self._device.safe()

    def _play(self, commands: Codes, records: Records) -> None:
        step_in, step_out = self._electronics.step_in, self._electronics.step_out
        self._device.send(self._tick, commands.astype(np.float64) * step_out)
        raw = self._device.receive()
        records["analog"] = np.rint(raw.analog / step_in)
        # As a counter of 32 bits shows them.
        records["counts"] = (np.rint(raw.counts).astype(np.int64) + 2**31) % 2**32 - 2**31
        records["count_rate"] = raw.count_rate
        records["applied"] = np.rint(raw.applied / step_out)
        records["flags"] = raw.flags
        self._tick += len(raw.tick)


def identity(name: str, electronics: Electronics, max_rate: float) -> Welcome:
    """WELCOME of a microcontroller with such converters."""
    low, high = electronics.volts
    inputs = [Channel(item, "V", electronics.step_in, 0.0, low, high) for item in ANALOG_INPUTS]
    outputs = [Channel(item, "V", electronics.step_out, 0.0, low, high) for item in CHANNELS]
    counts = np.iinfo(np.int32)
    counter = Channel("encoder", "count", 1.0, 0.0, float(counts.min), float(counts.max))
    return Welcome(
        device=name,
        firmware="emulator 1",
        serial="simulated",
        clock=_CLOCK,
        max_rate=max_rate,
        queue=_QUEUE,
        max_payload=1024,
        watchdog_default=100,
        watchdog_longest=10_000,
        channels=(*inputs, *outputs, counter),
    )


def warm_up(simulation: Simulation) -> float:
    """Compile what the rig computes with, before a host waits for it; its highest rate [Hz]."""
    device = simulation.board().device
    wide = np.full(3, 1e9)
    info = device.open()
    device.start(1000.0, Mode.CLOSED_LOOP, Guard(np.full(2, -1.0), np.full(2, 1.0), -wide, wide))
    for tick, n in ((0, 1), (1, 20)):
        device.send(tick, np.zeros((n, len(CHANNELS))))
        device.receive()
    device.close()
    return info.max_rate
