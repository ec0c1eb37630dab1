"""What may go wrong in a rig, each a small object that changes one place of its chain.

    amplifiers -> plant -> sensors -> converters -> counter and volts -> samples -> host

A fault acts from its instant on. The board calls its hooks only then; a hook that a fault leaves
alone hands on what it gets.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.faults.plant import COUNTS, FREE, HAND, LOADS, PULLEY

CURRENT_MOTOR, CURRENT_BRAKE, TORQUE = ANALOG = range(3)
MOTOR, BRAKE = range(2)
FULL_SCALE = 10.0  # V


@dataclass
class Fault:
    """Nothing wrong; the base of what is.

    size: how much, in the unit that each says. loads: on which it can be. ignores_safe: outputs
    follow no request to be zero. clock: how many times too fast the device's clock runs. lost:
    share of samples that do not arrive; damaged: share of frames that arrive wrong, both ways.
    ends: "mute", "hung" or "reset". pause: for how long the host is not heard [s].
    """

    size: float = 1.0
    loads: tuple[str, ...] = LOADS
    ignores_safe: bool = False
    clock: float = 1.0
    lost: float = 0.0
    damaged: float = 0.0
    ends: str = ""
    pause: float = 0.0

    def strike(self, board):
        """The instant itself: the plant changes."""

    def drive(self, volts, board):
        """Volts that reach the amplifiers, [motor, brake], of those that the outputs give."""
        return volts

    def measure(self, volts, board):
        """Volts that the sensors give, [current_motor, current_brake, torque]."""
        return volts

    def convert(self, volts, board):
        """Volts that the converters read, noise and steps among them."""
        return volts

    def count(self, count, rate, board):
        """What the counter shows, and its rate [1/s]."""
        return count, rate

    def echo(self, volts):
        """What the samples say was applied."""
        return volts


def _replaced(values, place, value):
    values = list(values)
    values[place] = value
    return values


@dataclass
class OutputGain(Fault):
    """An amplifier whose gain is ``size`` times what it was."""

    channel: int = MOTOR

    def drive(self, volts, board):
        return _replaced(volts, self.channel, self.size * volts[self.channel])


@dataclass
class OutputStuck(Fault):
    """An amplifier's input that stays at ``size`` volts."""

    channel: int = MOTOR

    def drive(self, volts, board):
        return _replaced(volts, self.channel, self.size)


@dataclass
class OutputStuckAfterSafe(Fault):
    """Amplifiers that keep what they had when they should have gone to zero."""

    kept: list[float] = field(default_factory=lambda: [0.0, 0.0])

    def drive(self, volts, board):
        if any(volts):
            self.kept = volts
        return self.kept


@dataclass
class SensorGain(Fault):
    """A sensor that gives ``size`` times what it should; its noise stays."""

    place: int = TORQUE

    def measure(self, volts, board):
        return _replaced(volts, self.place, self.size * volts[self.place])


@dataclass
class SensorOffset(Fault):
    """A sensor that is ``size`` volts off, or drifts by as much a second."""

    place: int = TORQUE
    drifts: bool = False

    def measure(self, volts, board):
        off = self.size * (board.since_fault if self.drifts else 1.0)
        return _replaced(volts, self.place, volts[self.place] + off)


@dataclass
class InputStuck(Fault):
    """Converters that read the same to the bit."""

    places: tuple[int, ...] = ANALOG
    kept: list[float] | None = None

    def convert(self, volts, board):
        if self.kept is None:
            self.kept = list(volts)
        return [self.kept[i] if i in self.places else volts[i] for i in ANALOG]


@dataclass
class InputAt(Fault):
    """A converter that reads ``size`` volts: the end of its range, or no number."""

    place: int = TORQUE

    def convert(self, volts, board):
        return _replaced(volts, self.place, self.size)


@dataclass
class Encoder(Fault):
    """An encoder of whose edges the counter sees ``size``; 0: dead, -1: turned."""

    first: float | None = None
    shown: float = 0.0

    def count(self, count, rate, board):
        if self.first is None:
            self.first = self.shown = count
        self.shown += self.size * (count - self.first)
        self.first = count
        return math.floor(self.shown), self.size * rate


@dataclass
class RateStuck(Fault):
    """A rate that stays what it was, or is ``size`` [1/s]; the count is right."""

    size: float = math.nan

    def count(self, count, rate, board):
        if math.isnan(self.size):
            self.size = rate
        return count, self.size


@dataclass
class CountStuck(Fault):
    """A count that stays what it was; the rate is right."""

    kept: float | None = None

    def count(self, count, rate, board):
        if self.kept is None:
            self.kept = count
        return self.kept, rate


@dataclass
class CountSlips(Fault):
    """A count that loses ``size`` counts every now and then, in ``share`` of the samples."""

    share: float = 0.05
    slipped: float = 0.0

    def count(self, count, rate, board):
        if board.rng.random() < self.share:
            self.slipped += self.size * board.rng.choice([-1.0, 1.0])
        return count - self.slipped, rate


@dataclass
class PlantChange(Fault):
    """Parameters of the plant that become others."""

    change: Callable[..., dict[str, float]] = lambda parameters: {}

    def strike(self, board):
        plant = board.plant
        plant.parameters = plant.parameters._replace(**self.change(plant.parameters))
        if plant.parameters.locked:
            plant.state[2] = 0.0


@dataclass
class AllFrozen(Fault):
    """A device that sends its last reading again and again."""

    kept: tuple | None = None

    def convert(self, volts, board):
        if self.kept is None:
            self.kept = (list(volts), board.plant.count, board.plant.count_rate)
        return self.kept[0]

    def count(self, count, rate, board):
        return self.kept[1:] if self.kept else (count, rate)


@dataclass
class EchoGain(Fault):
    """Samples that say ``size`` times what was applied."""

    def echo(self, volts):
        return [self.size * value for value in volts]


def _let_go_of_mass(parameters):
    return {"cable": 0.0, "loss": 0.0}


_JUMP = 0.8 * COUNTS / (2.0 * math.pi) * 1000.0 / 800.0  # counts; below encoder.fastest at 800 Hz
_VOLTS_PER_AMPERE = 2.0

FAULTS = {
    "encoder dead": Encoder(0.0),
    "encoder sign turned": Encoder(-1.0),
    "encoder half the counts": Encoder(0.5),
    "encoder slips": CountSlips(20.0),
    "encoder jumps": CountSlips(_JUMP, share=0.01),
    "rate dead": RateStuck(0.0),
    "rate stuck": RateStuck(),
    "count dead": CountStuck(),
    "motor output dead": OutputGain(0.0),
    "motor output x0.1": OutputGain(0.1),
    "motor output x2": OutputGain(2.0),
    "motor output turned": OutputGain(-1.0),
    "motor output stuck 1 V": OutputStuck(1.0),
    "motor output stuck 5 V": OutputStuck(5.0),
    "brake output dead": OutputGain(0.0, channel=BRAKE),
    "brake output x2": OutputGain(2.0, channel=BRAKE),
    "brake output stuck 0.2 V": OutputStuck(0.2, channel=BRAKE),
    "outputs stuck after SAFE": OutputStuckAfterSafe(),
    "current_motor dead": SensorGain(0.0, place=CURRENT_MOTOR),
    "current_motor x0.1": SensorGain(0.1, place=CURRENT_MOTOR),
    "current_motor turned": SensorGain(-1.0, place=CURRENT_MOTOR),
    "current_motor stuck": InputStuck(places=(CURRENT_MOTOR,)),
    "current_motor off by 0.5 A": SensorOffset(0.5 * _VOLTS_PER_AMPERE, place=CURRENT_MOTOR),
    "current_brake dead": SensorGain(0.0, place=CURRENT_BRAKE),
    "current_brake x0.1": SensorGain(0.1, place=CURRENT_BRAKE),
    "current_brake stuck": InputStuck(places=(CURRENT_BRAKE,)),
    "current_brake off by 0.05 A": SensorOffset(0.05 * _VOLTS_PER_AMPERE, place=CURRENT_BRAKE),
    "torque dead": SensorGain(0.0),
    "torque turned": SensorGain(-1.0),
    "torque x3": SensorGain(3.0),
    "torque drifts": SensorOffset(0.2, drifts=True),
    "torque stuck": InputStuck(places=(TORQUE,)),
    "current_motor saturated": InputAt(FULL_SCALE, place=CURRENT_MOTOR),
    "torque saturated": InputAt(FULL_SCALE),
    "current_motor NaN": InputAt(math.nan, place=CURRENT_MOTOR),
    "torque NaN": InputAt(math.nan),
    "inputs frozen": AllFrozen(),
    "shaft blocked": PlantChange(change=lambda parameters: {"locked": True}),
    "load falls off": PlantChange(change=_let_go_of_mass, loads=(PULLEY,)),
    "supply sags": PlantChange(change=lambda parameters: {"supply": 3.0}),
    "clock 10 % fast": Fault(clock=1.1),
    "SAFE ignored": Fault(ignores_safe=True),
    "applied echoed wrong": EchoGain(0.5),
    "samples lost": Fault(lost=0.05),
    "frames damaged": Fault(damaged=0.05),
    "device resets": Fault(ends="reset"),
    "device mute": Fault(ends="mute"),
    "device hangs": Fault(ends="hung"),
    "host paused 50 ms": Fault(pause=0.05),
    "host paused 0.5 s": Fault(pause=0.5),
}
"""All of them by name, in the order of the chain."""

VIRTUAL = tuple(name for name, fault in FAULTS.items() if not fault.damaged)
"""Those that need no line."""


ON_A_LINE = tuple(name for name in FAULTS if not name.endswith("NaN"))
"""Those that codes of 16 bits can show."""


def make(name, size=None):
    """A fault of this name, new; size: in place of its own. "" is none."""
    fault = copy.deepcopy(FAULTS[name]) if name else Fault()
    if size is not None:
        fault.size = size
    return fault


__all__ = ["FAULTS", "FREE", "HAND", "ON_A_LINE", "VIRTUAL", "Fault", "make"]
