"""The hardware abstraction layer: what a rig is to everything above it.

One tick, on every backend: at device time t_k the device latches all sensors, *then* applies
command u_k and holds it until t_k+1. Row k of a log is therefore (y_k, u_k) with y_k older
than u_k, and a simulation of it is x_k+1 = Phi(x_k, u_k), y_k = h(x_k).

A backend implements ``Device`` in raw volts and counts. ``daq.rig.Rig`` puts SI units, clamps
and interlocks around any device, so that those exist once.
"""

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import Field, FiniteFloat

from daq.errors import Mistake

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

CHANNELS = ("motor", "brake")
ANALOG_INPUTS = ("current_motor", "current_brake", "torque")


class Flag(enum.IntFlag):
    """What else is to be known of a sample; bits of the log's ``flags`` column."""

    CLAMPED = 1  #: The command asked for was outside its range; the range's end was applied.
    HELD = 2  #: No command had arrived for this tick; the device held the one before.
    LOST = 4  #: Samples are missing between the row before and this one.
    INTERLOCK = 8  #: A limit was passed in this sample; from it on the outputs are zero.
    UNDERFLOW = 16  #: The preloaded waveform ran dry; the outputs are zero.
    SATURATED = 32  #: An analog input stood at the end of its converter's range.
    DOUBTFUL = 64  #: What was measured disagrees in a way that does not end a run; see run.json.
    LAW = 128  #: The device's own torque controller made the command, not the host.


DEVICE_FLAGS = int(
    Flag.CLAMPED | Flag.HELD | Flag.INTERLOCK | Flag.UNDERFLOW | Flag.SATURATED | Flag.LAW
)
"""What a device may set; the others are the host's."""


class Mode(enum.Enum):
    """Who decides when a command is late."""

    OPEN_LOOP = "open loop"
    """The waveform is preloaded and played by the device's clock; running dry zeroes it."""
    CLOSED_LOOP = "closed loop"
    """One command per tick; a tick without one holds the command before and flags HELD."""


class Phase(enum.Enum):
    """Steps of a run, in order."""

    OPEN = "open"
    CALIBRATION = "calibration"
    HOMING = "homing"
    RUN = "run"
    SAFE = "safe"
    CLOSE = "close"


@dataclass(frozen=True)
class RawSamples:
    """A block of consecutive device frames, n rows, in the device's own units.

    tick: (n,), index of the sample since ``start``; a gap means lost samples.
    analog: (n, 3), volts at the inputs in ``ANALOG_INPUTS`` order.
    counts: (n,), quadrature counts, whole numbers on hardware. count_rate: (n,), the device's
    estimate of their rate [1/s].
    applied: (n, 2), volts applied from this tick on, in ``CHANNELS`` order. flags: (n,).
    """

    tick: IntArray
    analog: FloatArray
    counts: FloatArray
    count_rate: FloatArray
    applied: FloatArray
    flags: IntArray


@dataclass(frozen=True)
class Samples:
    """A block of samples in SI units, each field (n,), as the log stores it.

    cmd_* is what was asked, applied_* what the device did [V at the amplifier input].
    """

    tick: IntArray
    time: FloatArray
    cmd_voltage_motor: FloatArray
    cmd_voltage_brake: FloatArray
    applied_voltage_motor: FloatArray
    applied_voltage_brake: FloatArray
    current_motor: FloatArray
    current_brake: FloatArray
    torque: FloatArray
    theta: FloatArray
    omega: FloatArray
    flags: IntArray

    def __len__(self) -> int:
        return len(self.tick)


@dataclass(frozen=True)
class Guard:
    """Limits that the device itself enforces within one tick, in volts and counts.

    command_low/high: (2,), outputs are clamped to them. A latched input beyond one of the others
    zeroes both outputs until the next ``start`` and flags INTERLOCK: analog_low/high, (3,);
    counts_low/high, of the counter since tick 0; count_rate, of the rate's magnitude [1/s];
    count_step, of the counter's change from tick to tick. Infinity: not watched.
    """

    command_low: FloatArray
    command_high: FloatArray
    analog_low: FloatArray
    analog_high: FloatArray
    counts_low: float = -math.inf
    counts_high: float = math.inf
    count_rate: float = math.inf
    count_step: float = math.inf


@dataclass(frozen=True)
class DeviceInfo:
    """Who answers, and what it can do.

    max_rate [Hz]; queue: commands it can hold ahead of time, one at least; volts_in: (low, high)
    of its analog inputs; virtual_time: whether its clock waits for the host. step_out [V]: by which
    what an output applies may differ from its command. law: which torque controller it has aboard,
    the fingerprint of its ``daq.torque.LawProgram``; empty for none.
    """

    name: Annotated[str, Field(max_length=200)]
    max_rate: Annotated[float, Field(gt=0.0)]
    queue: Annotated[int, Field(ge=1, le=1_000_000)]
    volts_in: tuple[FiniteFloat, FiniteFloat]
    virtual_time: bool = False
    step_out: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.01
    law: Annotated[str, Field(max_length=40)] = ""


@dataclass(frozen=True)
class LawScales:
    """What a device's own torque controller makes of its inputs and of its reference.

    angle: rad of a count. current_motor: A per volt, and A at 0 V. torque: N*m per volt, and N*m at
    0 V. reference: torque on the hand [N*m] that a volt of the motor's command asks for.
    """

    angle: float
    current_motor: tuple[float, float]
    torque: tuple[float, float]
    reference: float


@runtime_checkable
class Reporting(Protocol):
    """A device that has more to say for the record of a run than its name."""

    def report(self) -> dict[str, Any]:
        """Facts about device and connection that JSON can hold; at any time, also when closed."""


@runtime_checkable
class Disclosing(Protocol):
    """A device that says beforehand what it cannot promise."""

    def caveats(self) -> list[Mistake]:
        """What it cannot promise, each with what to do about it; at any time."""


@runtime_checkable
class Answering(Protocol):
    """A device that may have a torque controller aboard (``DeviceInfo.law``)."""

    def answer(self, first: int, blend: int, scales: LawScales | None) -> None:
        """From tick ``first`` on its controller answers the samples, flagged LAW; None: no longer.

        The motor's commands are its references meanwhile, those of the brake count for nothing. The
        outputs move over from the ones to the others in ``blend`` ticks. Limits hold as ever.
        Between ``start`` and ``stop``, and before that tick.
        """


class Device(Protocol):
    """What a backend implements.

    Methods raise ``DeviceError`` with cause and cure; ``safe`` never raises.
    """

    def open(self) -> DeviceInfo:
        """Connect; outputs are zero afterwards.

        What takes long, such as imports and compilation, is done here: real-time scheduling begins
        behind it.
        """

    def announce(self, phase: Phase, turns: float = 0.0) -> None:
        """Tell whoever stands at the rig which phase begins; homing asks to wind ``turns``.

        Hardware has nothing to do here; the simulated rig's user acts on it.
        """

    def start(self, sample_rate: float, mode: Mode, guard: Guard) -> None:
        """Begin sampling with tick 0 and zero outputs at ``sample_rate`` [Hz].

        In open loop the clock starts when the first commands have been sent.
        """

    def send(self, tick: int, commands: FloatArray) -> None:
        """Queue commands (n, 2) [V] for ticks ``tick``, ``tick + 1``, ..."""

    def room(self) -> int:
        """How many more commands the queue can take now."""

    def receive(self) -> RawSamples:
        """Block until at least one sample is there; return all that are."""

    def stop(self) -> None:
        """End sampling; outputs are zero afterwards."""

    def safe(self) -> None:
        """Zero both outputs now, in any state, any number of times, without raising.

        Sampling goes on until ``stop``: the host reads back what is applied.
        """

    def close(self) -> None:
        """Disconnect; outputs are zero afterwards."""


@dataclass(frozen=True)
class Electronics:
    """A computed plant, and the converters that a board would have around it.

    device: the plant in virtual time. volts: (low, high), range of inputs and outputs. step_in,
    step_out: their resolution [V]. latch: the inputs at the device's next tick, one row, before its
    command is known; what ``receive`` then gives has the same.
    """

    device: Device
    volts: tuple[float, float]
    step_in: float
    step_out: float
    latch: Callable[[], RawSamples]


@runtime_checkable
class Simulation(Protocol):
    """A device whose plant is computed, and therefore known."""

    def process_model(self) -> Any:
        """The plant as a ``sysid.ProcessModel`` whose nominal values are the plant's.

        Raises ``sysid.ModelError`` for a plant that no process model can be made of.
        """

    def plant_model(self, turns: float) -> Any:
        """The whole plant as a ``sysid.ProcessModel`` of which only commands are inputs that count.

        Its outputs are named as the fields of ``Samples``; turns: of its cable, wound up before.
        Raises ``sysid.ModelError`` where nobody can say beforehand what it does.
        """

    def board(self) -> Electronics:
        """The same plant anew, without faults of its connection, for a board to serve."""
