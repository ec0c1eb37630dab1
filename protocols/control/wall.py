"""A virtual wall, spring and damper, rendered at each point of a grid: settings and controller."""

import itertools
import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import NewtonMetres, Radians, RadiansPerSecond, Seconds, Unit, Volts
from daq.errors import RunError
from daq.experiment import Answer, Sample
from daq.hal import FloatArray
from daq.torque import TorqueLaw
from haptics.experiment import TorqueExperiment
from protocols.control import loop

Stiffness = Annotated[float, Unit("N*m/rad")]
Damping = Annotated[float, Unit("N*m*s/rad")]

RESTING, RAMPING, WATCHED, ABORTED = range(4)
"""The log's column ``state``."""

_CONTACT = 0.5  # s of contact that begin the first cell


class Rest(Section):
    """The soft wall between two cells, in which a ringing hand calms down."""

    stiffness: Stiffness = Field(1.0, gt=0.0, le=100.0, description="of the soft wall")
    damping: Damping = Field(0.005, ge=0.0, le=1.0, description="of the soft wall")
    time: Seconds = Field(0.4, gt=0.0, le=60.0, description="spent in it, and on the way to a cell")


class Tap(Section):
    """A pulse of torque into the wall that sets it swinging, if it will."""

    torque: NewtonMetres = Field(0.06, ge=0.0, le=10.0, description="of the pulse")
    time: Seconds = Field(0.005, gt=0.0, le=1.0, description="length of the pulse")


class RingingTest(Section):
    """When a wall counts as unstable."""

    watch: Seconds = Field(
        0.6,
        gt=0.0,
        le=60.0,
        description="time after the tap; the oscillation in its second half is what counts",
    )
    amplitude: Radians = Field(
        0.003, gt=0.0, le=1.0, description="amplitude of that oscillation from which it rings"
    )
    speed: RadiansPerSecond = Field(
        8.0, gt=0.0, le=1000.0, description="of the shaft, at which a cell is left at once"
    )


class Body(Section):
    """What is physical, for the passivity bound and the stability to compare with."""

    inertia: Annotated[float, Unit("kg*m^2")] = Field(gt=0.0, description="of all that turns")
    damping: Damping = Field(
        ge=0.0, description="of motor and brake: b in (1.1), b > K T / 2 + |B|"
    )
    brake_damping: Annotated[float, Unit("N*m*s/(rad*V)")] = Field(
        0.0, ge=0.0, description="what each volt at the brake adds, for b_passive in (1.2)"
    )
    hand_stiffness: Stiffness = Field(0.0, ge=0.0, description="of the hand, where it is known")
    hand_damping: Damping = Field(0.0, ge=0.0, description="of the hand, where it is known")


class Cell(NamedTuple):
    """One wall of the grid: stiffness [N*m/rad], damping [N*m*s/rad], brake in contact [V]."""

    stiffness: float
    damping: float
    brake: float


class WallSettings(TorqueExperiment):
    """A grid of walls, how each is tried, and what is physical."""

    columns: ClassVar[Mapping[str, str]] = {
        "cell": "1",
        "state": "1",
        "stiffness": "N*m/rad",
        "damping": "N*m*s/rad",
        "penetration": "rad",
    }

    torque_controller: str = Field(
        "", description="file that rig tune made; without one a torque is volts by motor_gain"
    )
    position: Radians = Field(
        0.2, ge=0.0, le=100.0, description="of the wall, from where the shaft is at first"
    )
    stiffnesses: list[Stiffness] = Field(
        min_length=1, max_length=100, description="rising; of the walls"
    )
    dampings: list[Damping] = Field(min_length=1, max_length=100, description="of the walls")
    brake_commands: list[Volts] = Field(
        [0.0], min_length=1, max_length=10, description="while in contact; a map for each"
    )
    rest: Rest = Field(Rest(), description="the soft wall between two cells")
    tap: Tap = Field(Tap(), description="what sets each wall swinging")
    ringing: RingingTest = Field(RingingTest(), description="when a wall counts as unstable")
    speed_filter: loop.TrackerBandwidth = Field(
        loop.TRACKER_BANDWIDTH, description="bandwidth of the speed that the damping sees"
    )
    motor_gain: Annotated[float, Unit("N*m/V")] = Field(
        gt=0.0, description="motor torque per volt of command"
    )
    motor_limit: loop.MotorLimit = loop.MOTOR_LIMIT
    patience: Seconds = Field(
        20.0, gt=0.0, le=3600.0, description="time allowed for a hand to lean against the wall"
    )
    body: Body = Field(description="what is physical")

    @property
    def cells(self) -> tuple[Cell, ...]:
        """All walls in the order in which they are visited: stiffer and stiffer."""
        grid = itertools.product(self.brake_commands, self.dampings, self.stiffnesses)
        return tuple(Cell(stiffness, damping, brake) for brake, damping, stiffness in grid)


class WallRenderer:
    """Controller: rests in a soft wall, goes to a cell's, taps it, watches it ring or not."""

    def __init__(self, settings: WallSettings) -> None:
        self._settings, self._cells = settings, settings.cells
        self._tracker = loop.SpeedTracker(settings.speed_filter)
        self._law: TorqueLaw | None = None
        if settings.is_controlled:
            self._law = settings.tuned_controller.law()
        self._wall: float | None = None
        self._touched = math.nan
        self._index, self._began = -1, 0.0
        self._depths: list[tuple[float, float]] = []  # while watched: time [s], depth [rad]

    def answer(self, sample: Sample) -> Answer | None:
        """The wall's torque, in volts."""
        settings, now = self._settings, sample.time
        speed = self._tracker.update(now, sample.theta)
        if self._wall is None:
            self._wall = sample.theta + settings.position
        depth = sample.theta - self._wall
        index, state = self._index, RESTING
        if index < 0:
            self._wait(now, depth)
        elif index == len(self._cells):
            index = -1
            if now - self._began > settings.rest.time:
                return None
        else:
            state = self._state(now, speed)
        if state == ABORTED:
            self._leave(now, unstable=True)
        stiffness, damping, brake = self._rendered(now)
        torque = -(stiffness * depth + damping * speed) if depth > 0.0 else 0.0
        tapped = now - self._began - 2.0 * settings.rest.time
        if state in (RAMPING, WATCHED) and 0.0 <= tapped < settings.tap.time:
            torque += settings.tap.torque
        if state == WATCHED:
            self._watch(now, depth)
        contact = brake if depth > 0.0 else 0.0
        logged = (float(index), float(state), stiffness, damping, depth)
        if self._law is not None:
            motor, shared = self._law.volts(sample, torque)
            return Answer(motor, max(shared, contact), logged)
        volts, limit = torque / settings.motor_gain, settings.motor_limit
        return Answer(min(max(volts, -limit), limit), contact, logged)

    def _wait(self, now: float, depth: float) -> None:
        """For a hand that leans against the wall."""
        if not depth > 0.0:
            self._touched = math.nan
        elif math.isnan(self._touched):
            self._touched = now
        elif now - self._touched >= _CONTACT:
            self._index, self._began = 0, now
        if self._index < 0 and now > self._settings.patience:
            raise RunError(
                f"nobody leant against the wall within {self._settings.patience:g} s: turn the "
                f"handle {self._settings.position:g} rad forwards and hold it there. On the "
                "simulated rig take hand.yaml, or give options.hand"
            )

    @property
    def _watch_from(self) -> float:
        """Time in a cell from which its oscillation counts [s]."""
        settings = self._settings
        return 2.0 * settings.rest.time + settings.tap.time + 0.5 * settings.ringing.watch

    def _state(self, now: float, speed: float) -> int:
        """What this sample of a cell is of."""
        if now - self._began < self._settings.rest.time:
            return RESTING
        if abs(speed) > self._settings.ringing.speed:
            return ABORTED
        return RAMPING if now - self._began < self._watch_from else WATCHED

    def _watch(self, now: float, depth: float) -> None:
        """Note the depth; to the next cell once this one was watched to its end."""
        ringing = self._settings.ringing
        self._depths.append((now, depth))
        if now - self._began >= self._watch_from + 0.5 * ringing.watch:
            swing = oscillation(*np.array(self._depths).T)
            self._leave(now, unstable=swing > ringing.amplitude)

    def _leave(self, now: float, unstable: bool) -> None:
        """To the next cell; past stiffer ones of the same damping where this one was unstable."""
        left = self._cells[self._index]
        self._index, self._began, self._depths = self._index + 1, now, []
        while unstable and self._index < len(self._cells):
            cell = self._cells[self._index]
            if (cell.brake, cell.damping) != (left.brake, left.damping):
                break
            self._index += 1

    def _rendered(self, now: float) -> tuple[float, float, float]:
        """Stiffness, damping and brake command, on the way from the soft wall to the cell's."""
        rest = self._settings.rest
        if not 0 <= self._index < len(self._cells):
            return rest.stiffness, rest.damping, 0.0
        cell = self._cells[self._index]
        share = min(max((now - self._began - rest.time) / rest.time, 0.0), 1.0)
        stiffness = rest.stiffness + share * (cell.stiffness - rest.stiffness)
        damping = rest.damping + share * (cell.damping - rest.damping)
        return stiffness, damping, cell.brake


def oscillation(time: FloatArray, depth: FloatArray) -> float:
    """Amplitude of an oscillation about a straight line, sqrt(2) times its deviation [rad]."""
    away = time - time.mean()
    slope = float(away @ depth) / float(away @ away) if len(time) > 1 else 0.0
    return math.sqrt(2.0) * float(np.std(depth - slope * away))
