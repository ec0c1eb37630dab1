"""Electronics around the plant: sensors, converters, counter, the fault, and the truth.

What a firmware can do on it is ``latch`` its inputs and ``drive`` its outputs until the next tick.
"""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.faults import faults
from tests.faults.plant import I_BRAKE, I_MOTOR, LET_GO, OMEGA, THETA, Grip, Plant, draw

STEP = 20.0 / 65536  # V, of 16 bits over +-10 V
END = 10.0 - STEP
SATURATED = 32

_VOLTS = (2.0, 2.0, 1.0 / 0.706)  # per ampere, ampere and N*m
_WINDING = 1.5  # turns/s by hand
_MORE = 0.1  # turns that a hand winds beyond those asked for
_ARM = Grip(stiffness=1.0, damping=0.02, angle=0.0, rate=0.0)  # that winds
_FINGERS = Grip(stiffness=0.16, damping=0.0179, angle=0.0, rate=0.0)  # of the load ``hand``
_LEAN = 1.0  # rad, reached after 1 s
_COAST = 1.0  # s that is watched after the end

_PHASES = ("open", "calibration", "homing", "run", "safe", "close")


class Reading(NamedTuple):
    """Latched inputs: volts (3,), counts, counts per second, flags."""

    analog: list[float]
    count: int
    rate: float
    flags: int


@dataclass(frozen=True)
class Setting:
    """Which rig of many, and what goes wrong with it.

    seed: of plant and noise. noise, offset: V rms, and largest V, on the inputs. fault: its name,
    "" for none, ``size`` of its own unless given, ``at`` seconds into ``phase``, or when the next
    phase begins.
    """

    seed: int = 0
    load: str = "free"
    sensor: str = "between"
    noise: float = 0.010
    offset: float = 0.020
    fault: str = ""
    size: float | None = None
    phase: str = "run"
    at: float = 0.0


@dataclass
class Truth:
    """What really happened, from the instant of the fault on, or from the beginning without one.

    Times in seconds of the plant: onset, None while it has not come; safe, since when the outputs
    have been told to be zero, None while they are not; ended, when the host had gone. Peaks are
    magnitudes [rad/s, A, A], also while it coasts at the end. energy: from the supply [J]. output:
    volts at the amplifiers at the very end. trace: time, omega, currents and volts at the
    amplifiers, tick by tick.
    """

    onset: float | None = None
    safe: float | None = None
    ended: float | None = None
    omega: float = 0.0
    current_motor: float = 0.0
    current_brake: float = 0.0
    energy: float = 0.0
    output: list[float] = field(default_factory=lambda: [0.0, 0.0])
    trace: list[tuple[float, ...]] = field(default_factory=list)

    def write(self, path):
        """As JSON."""
        Path(path).write_text(json.dumps(asdict(self)), encoding="utf-8")


class Board:
    """One rig; ``plant`` is the truth, ``latch`` what a firmware sees of it."""

    def __init__(self, setting):
        self.setting = setting
        self.plant = Plant(draw(setting.seed, setting.load), setting.load)
        self.rng = np.random.default_rng([setting.seed, 7])
        self.fault = faults.make(setting.fault, setting.size)
        self.active = False
        self.truth = Truth()
        self._healthy = faults.Fault()
        self._zero = self.rng.uniform(-setting.offset, setting.offset, 3)
        self._phase, self._begun = 0, 0.0
        self._wrist = 0.0  # rad, where the hand began
        self._turns = 0.0

    @property
    def now(self):
        """The fault that acts now; one that changes nothing before its instant."""
        return self.fault if self.active else self._healthy

    @property
    def since_fault(self):
        """Seconds since its instant."""
        return self.plant.time - (self.truth.onset or 0.0)

    def announce(self, phase, turns=0.0):
        """A phase begins, by its name; the hand at the rig does its part."""
        self._phase, self._begun = _PHASES.index(phase), self.plant.time
        self._wrist, self._turns = float(self.plant.state[THETA]), turns
        self._wait_for_fault()

    def latch(self):
        """Inputs as they are now; a Reading."""
        plant, now = self.plant, self.now
        true = (plant.state[I_MOTOR], plant.state[I_BRAKE], plant.torque(self.setting.sensor))
        volts = now.measure([value * per for value, per in zip(true, _VOLTS, strict=True)], self)
        noise = self._zero + self.setting.noise * self.rng.standard_normal(3)
        read = [_converted(value) for value in (np.array(volts) + noise).tolist()]
        volts = now.convert(read, self)
        count, rate = now.count(plant.count, plant.count_rate, self)
        saturated = any(abs(value) >= END for value in volts)
        return Reading(volts, int(count), rate / now.clock, SATURATED * saturated)

    def drive(self, motor, brake, period):
        """These volts at the outputs for one period [s] of the device's clock."""
        self._wait_for_fault()
        volts = self.now.drive([motor, brake], self)
        self.plant.grip = self._grip()
        advance = self.plant.advance(*volts, period / self.now.clock)
        if self.active or not self.setting.fault:
            self._note(volts, advance)

    def told_safe(self):
        """The outputs have been told to be zero, by host or firmware."""
        if self.truth.safe is None:
            self.truth.safe = self.plant.time

    def told_volts(self):
        """The outputs have been told to be something else."""
        self.truth.safe = None

    def coast(self, motor, brake, period):
        """The host has gone: what the shaft does with what the outputs still give."""
        if self.truth.ended is not None:
            return
        self.truth.ended = self.plant.time
        for _ in range(round(_COAST / period)):
            self.drive(motor, brake, period)

    def _wait_for_fault(self):
        phase = _PHASES.index(self.setting.phase)
        due = self.plant.time - self._begun >= self.setting.at - 1e-9
        if self.active or not self.setting.fault:
            return
        if self._phase > phase or (self._phase == phase and due):
            self.active = True
            self.truth.onset = self.plant.time
            self.fault.strike(self)

    def _grip(self):
        seconds = self.plant.time - self._begun
        if _PHASES[self._phase] == "homing" and self._turns:
            target = 2.0 * math.pi * (self._turns + _MORE)
            part = min(1.0, seconds * _WINDING / self._turns)
            angle = self._wrist + target * (1.0 - math.cos(math.pi * part)) / 2.0
            rate = math.pi * math.pi * _WINDING * math.sin(math.pi * part) * (part < 1.0)
            return _ARM._replace(angle=angle, rate=rate)
        if self.setting.load != "hand":
            return LET_GO
        if _PHASES[self._phase] == "run":
            lean = min(seconds, 1.0) * _LEAN
            return _FINGERS._replace(angle=self._wrist + lean, rate=_LEAN * (seconds < 1.0))
        return _FINGERS._replace(angle=self._wrist)

    def _note(self, volts, advance):
        truth, state = self.truth, self.plant.state
        truth.omega = max(truth.omega, advance.omega)
        truth.current_motor = max(truth.current_motor, advance.current_motor)
        truth.current_brake = max(truth.current_brake, advance.current_brake)
        truth.energy += advance.energy
        truth.output = list(volts)
        if self.setting.fault:
            values = (self.plant.time, state[OMEGA], state[I_MOTOR], state[I_BRAKE], *volts)
            truth.trace.append(tuple(map(float, values)))


def _converted(volts):
    """What 16 bits show of volts."""
    return min(max(round(volts / STEP) * STEP, -END - STEP), END)
