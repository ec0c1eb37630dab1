"""A virtual wall, spring and damper, at each point of a grid: which of them are stable."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Hertz, NewtonMetres, Radians, RadiansPerSecond, Seconds, Unit, Volts
from daq.errors import RunError
from daq.experiment import Answer, ClosedLoop, Controller, Plan, Sample
from daq.findings import Axis, Chart, Findings, Heatmap, Number, Series, Table
from daq.hal import FloatArray, Samples
from protocols.passivity import SampledWall, passive_stiffness
from protocols.pid import SpeedTracker

Stiffness = Annotated[float, Unit("N*m/rad")]
Damping = Annotated[float, Unit("N*m*s/rad")]

_CONTACT = 0.5  # s of contact that begin the first cell
_RESTING, _RAMPING, _WATCHED, _ABORTED = range(4)  # the log's column ``state``


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
        0.6, gt=0.0, le=60.0,
        description="time after the tap; the oscillation in its second half is what counts",
    )  # fmt: skip
    amplitude: Radians = Field(
        0.003, gt=0.0, le=1.0, description="amplitude of that oscillation from which it rings"
    )
    speed: RadiansPerSecond = Field(
        8.0, gt=0.0, le=1000.0, description="of the shaft, at which a cell is left at once"
    )


class Body(Section):
    """What is physical, for the passivity bound and the stability to compare with."""

    inertia: Annotated[float, Unit("kg*m^2")] = Field(gt=0.0, description="of all that turns")
    damping: Damping = Field(ge=0.0, description="of motor and brake, b in (1.1)")
    brake_damping: Annotated[float, Unit("N*m*s/(rad*V)")] = Field(
        0.0, ge=0.0, description="what each volt at the brake adds, for b_passive in (1.2)"
    )
    hand_stiffness: Stiffness = Field(0.0, ge=0.0, description="of the hand, where it is known")
    hand_damping: Damping = Field(0.0, ge=0.0, description="of the hand, where it is known")


@dataclass(frozen=True)
class Cell:
    """One wall of the grid: stiffness [N*m/rad], damping [N*m*s/rad], brake in contact [V]."""

    stiffness: float
    damping: float
    brake: float


class VirtualWall(ClosedLoop):
    """A wall of each stiffness and damping in turn; which ring, with the brake and without."""

    columns: ClassVar[Mapping[str, str]] = {
        "cell": "1", "state": "1", "stiffness": "N*m/rad", "damping": "N*m*s/rad",
        "penetration": "rad",
    }  # fmt: skip

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
    speed_filter: Hertz = Field(
        150.0, gt=0.0, le=1e4, description="bandwidth of the speed that the damping sees"
    )
    motor_gain: Annotated[float, Unit("N*m/V")] = Field(
        gt=0.0, description="motor torque per volt of command"
    )
    motor_limit: Volts = Field(
        4.5, gt=0.0, le=10.0, description="largest motor command, either way"
    )
    patience: Seconds = Field(
        20.0, gt=0.0, le=3600.0, description="time allowed for a hand to lean against the wall"
    )
    body: Body = Field(description="what is physical")

    @property
    def cells(self) -> tuple[Cell, ...]:
        """All walls in the order in which they are visited: stiffer and stiffer."""
        return tuple(
            Cell(stiffness, damping, brake)
            for brake in self.brake_commands
            for damping in self.dampings
            for stiffness in self.stiffnesses
        )

    def plan(self) -> Plan:
        """The longest that it can take, and what (1.1) says of the grid."""
        if any(b <= a for a, b in zip(self.stiffnesses, self.stiffnesses[1:], strict=False)):
            raise ValueError("stiffnesses: write them rising, so that soft walls come first")
        self._check_times()
        cell = 2.0 * self.rest.time + self.tap.time + self.ringing.watch
        seconds = self.patience + len(self.cells) * cell + self.rest.time
        return Plan(
            self.samples_in(seconds, "stiffnesses"),
            np.array([-self.motor_limit, min(0.0, *self.brake_commands)]),
            np.array([self.motor_limit, max(0.0, *self.brake_commands)]),
            remarks=tuple(self._bound(brake) for brake in self.brake_commands),
        )

    def preview(self) -> Chart:
        """The walls that will be tried, beside what theory says of them."""
        stiff, damped = np.meshgrid(self.stiffnesses, self.dampings)
        walls = Series("walls to be tried", damped.ravel(), stiff.ravel(), style="points")
        brake = self.brake_commands[0]
        return Chart(
            "walls", f"Walls to be tried, and theory with the brake at {brake:g} V",
            Axis("damping", "N*m*s/rad"), Axis("stiffness", "N*m/rad"),
            (walls, *_theory(self, brake)),
        )  # fmt: skip

    def controller(self) -> Controller:
        """The renderer of the walls."""
        return _Renderer(self)

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """Which walls rang, beside what theory says."""
        visited = _visited(self, samples, extra)
        if not visited:
            raise ValueError("no wall was watched to its end; did a hand lean against it?")
        return _Map(self, visited).findings()

    def physical(self, brake: float) -> float:
        """b + b_passive of (1.2) [N*m*s/rad]."""
        return self.body.damping + self.body.brake_damping * abs(brake)

    def loop(self, brake: float, hand: bool) -> SampledWall:
        """The sampled loop around the shaft, with the hand or without."""
        body = self.body
        return SampledWall(
            body.inertia,
            self.physical(brake) + (body.hand_damping if hand else 0.0),
            body.hand_stiffness if hand else 0.0,
            1.0 / self.sample_rate,
            self.ahead,
            self.speed_filter,
        )

    def _check_times(self) -> None:
        """ValueError for times in which too few samples come to tell anything."""
        shortest = {"rest.time": (self.rest.time, 2), "tap.time": (self.tap.time, 1),
                    "ringing.watch": (self.ringing.watch, 40)}  # fmt: skip
        for key, (seconds, least) in shortest.items():
            if round(seconds * self.sample_rate) < least:
                raise ValueError(
                    f"{key}: {seconds:g} s is less than {least} samples at "
                    f"{self.sample_rate:g} Hz; make it {least / self.sample_rate:.3g} s at least"
                )

    def _bound(self, brake: float) -> str:
        b = self.physical(brake)
        passive = [
            cell for cell in self.cells
            if cell.brake == brake
            and cell.stiffness < passive_stiffness(b, cell.damping, 1.0 / self.sample_rate)
        ]  # fmt: skip
        name, with_brake = ("(1.2)", f", brake at {brake:g} V") if brake else ("(1.1)", "")
        limit = passive_stiffness(b, 0.0, 1.0 / self.sample_rate)
        total = len(self.cells) // len(self.brake_commands)
        return (
            f"Passive by {name}{with_brake}: b = {b:.3g} N*m*s/rad > K T / 2 + |B| holds up to "
            f"K = {limit:.3g} N*m/rad without damping; {len(passive)} of the {total} walls are. "
            "The others are tried all the same: hold the handle firmly, and be ready to let go."
        )


class _Renderer:
    """Controller: rests in a soft wall, goes to a cell's, taps it, watches it ring or not."""

    def __init__(self, settings: VirtualWall) -> None:
        self._settings, self._cells = settings, settings.cells
        self._tracker = SpeedTracker(settings.speed_filter)
        self._wall: float | None = None
        self._touched = math.nan
        self._index, self._began = -1, 0.0
        self._amplitude = settings.ringing.amplitude
        self._watched: list[tuple[float, float]] = []
        self._done = False

    def answer(self, sample: Sample) -> Answer | None:
        """The wall's torque, in volts."""
        settings, now = self._settings, sample.time
        speed = self._tracker.update(now, sample.theta)
        if self._wall is None:
            self._wall = sample.theta + settings.position
        depth = sample.theta - self._wall
        if self._index == len(self._cells) and now - self._began > settings.rest.time:
            return None
        index = self._index if self._index < len(self._cells) else -1
        state = self._step(now, depth, speed)
        share = self._share(now) if state in (_RAMPING, _WATCHED) else 0.0
        stiffness, damping, brake = self._wall_at(share)
        torque = -(stiffness * depth + damping * speed) if depth > 0.0 else 0.0
        if state in (_RAMPING, _WATCHED) and self._tapping(now):
            torque += settings.tap.torque
        if self._done:
            self._leave(now, unstable=_amplitude(*np.array(self._watched).T) > self._amplitude)
        volts = torque / settings.motor_gain
        limit = settings.motor_limit
        logged = (float(index), float(state), stiffness, damping, depth)
        return Answer(min(max(volts, -limit), limit), brake if depth > 0.0 else 0.0, logged)

    def _step(self, now: float, depth: float, speed: float) -> int:
        """What this sample is of; goes on to the next cell when this one is done with."""
        if self._index < 0:
            self._wait(now, depth)
        if not 0 <= self._index < len(self._cells):
            return _RESTING
        rest, ringing = self._settings.rest.time, self._settings.ringing
        passed = now - self._began
        if passed < rest:
            return _RESTING
        if abs(speed) > ringing.speed:
            self._leave(now, unstable=True)
            return _ABORTED
        watch_from = 2.0 * rest + self._settings.tap.time + 0.5 * ringing.watch
        if passed < watch_from:
            return _RAMPING
        self._watched.append((now, depth))
        self._done = passed >= watch_from + 0.5 * ringing.watch
        return _WATCHED

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

    def _leave(self, now: float, unstable: bool) -> None:
        """To the next cell; past stiffer ones of the same damping where this one was unstable."""
        here = self._cells[self._index]
        self._index, self._began = self._index + 1, now
        self._watched, self._done = [], False
        while unstable and self._index < len(self._cells):
            cell = self._cells[self._index]
            if (cell.brake, cell.damping) != (here.brake, here.damping):
                break
            self._index += 1

    def _share(self, now: float) -> float:
        """How far on the way from the soft wall to the cell's, 0 to 1."""
        rest = self._settings.rest.time
        return min(max((now - self._began - rest) / rest, 0.0), 1.0)

    def _wall_at(self, share: float) -> tuple[float, float, float]:
        rest = self._settings.rest
        if not 0 <= self._index < len(self._cells):
            return rest.stiffness, rest.damping, 0.0
        cell = self._cells[self._index]
        return (
            rest.stiffness + share * (cell.stiffness - rest.stiffness),
            rest.damping + share * (cell.damping - rest.damping),
            cell.brake,
        )

    def _tapping(self, now: float) -> bool:
        begun = now - self._began - 2.0 * self._settings.rest.time
        return 0.0 <= begun < self._settings.tap.time


def _amplitude(time: FloatArray, depth: FloatArray) -> float:
    """Amplitude of an oscillation about a straight line, sqrt(2) times its deviation [rad]."""
    away = time - time.mean()
    slope = float(away @ depth) / float(away @ away) if len(time) > 1 else 0.0
    return math.sqrt(2.0) * float(np.std(depth - slope * away))


@dataclass(frozen=True)
class _Visit:
    """A cell, its oscillation [rad], infinite where it was left at once, and time in contact."""

    cell: Cell
    amplitude: float
    contact: float


def _visited(
    settings: VirtualWall, samples: Samples, extra: Mapping[str, FloatArray]
) -> list[_Visit]:
    """The cells that were watched to their end or left at once."""
    visits = []
    whole = 0.9 * 0.5 * settings.ringing.watch  # samples may be lost at its ends
    for index, cell in enumerate(settings.cells):
        own = extra["cell"] == index
        watched = own & (extra["state"] == _WATCHED)
        if (own & (extra["state"] == _ABORTED)).any():
            visits.append(_Visit(cell, math.inf, math.nan))
        elif watched.any() and np.ptp(samples.time[watched]) > whole:
            depth = extra["penetration"][watched]
            amplitude = _amplitude(samples.time[watched], depth)
            visits.append(_Visit(cell, amplitude, float(np.mean(depth > 0.0))))
    return visits


def _theory(settings: VirtualWall, brake: float) -> tuple[Series, ...]:
    """Bounds of stability and passivity over the damping."""
    dampings = np.linspace(min(settings.dampings), max(settings.dampings), 60)
    most = settings.stiffnesses[-1]
    lines = []
    for label, hand in (("stable, handle held", True), ("stable, handle free", False)):
        loop = settings.loop(brake, hand)
        bound = np.array([loop.critical_stiffness(d) for d in dampings])
        lines.append(Series(label, dampings, np.where(bound <= most, bound, math.nan)))
    b = settings.physical(brake)
    limit = passive_stiffness(b, 0.0, 1.0 / settings.sample_rate)
    lines.append(
        Series(
            "passive by (1.1)" if brake == 0.0 else "passive by (1.2)",
            np.array([0.0, b]),
            np.array([limit, 0.0]),
        )
    )
    return tuple(lines)


class _Map:
    """Which walls are stable."""

    def __init__(self, settings: VirtualWall, visits: list[_Visit]) -> None:
        self._settings, self._visits = settings, visits
        self._limit = settings.ringing.amplitude

    def findings(self) -> Findings:
        """All of it."""
        figures: list[Chart | Heatmap] = [
            self._figure(k, brake) for k, brake in enumerate(self._settings.brake_commands)
        ]
        return Findings(
            self._numbers(), (self._boundary(), self._cells()), tuple(figures), {}, self._remarks()
        )

    def _stable(self, visit: _Visit) -> bool:
        return visit.amplitude <= self._limit and visit.contact > 0.5

    def _stiffest(self, brake: float, damping: float) -> float:
        """The stiffest wall below the first that rang [N*m/rad]; 0 where the softest rang."""
        stiffest = 0.0
        for visit in self._visits:
            if (visit.cell.brake, visit.cell.damping) == (brake, damping):
                if not self._stable(visit):
                    break
                stiffest = visit.cell.stiffness
        return stiffest

    def _numbers(self) -> tuple[Number, ...]:
        numbers = []
        for k, brake in enumerate(self._settings.brake_commands):
            most = max(self._stiffest(brake, d) for d in self._settings.dampings)
            name = "stiffest" if k == 0 else f"stiffest_{k + 1}"
            meaning = f"stiffest wall that was stable, brake at {brake:g} V"
            numbers.append(Number(name, most, "N*m/rad", meaning=meaning))
        return tuple(numbers)

    def _boundary(self) -> Table:
        """By brake command and damping: the stiffest stable wall, and what theory says."""
        settings, period = self._settings, 1.0 / self._settings.sample_rate
        rows = []
        for brake in settings.brake_commands:
            held, alone = settings.loop(brake, hand=True), settings.loop(brake, hand=False)
            for damping in settings.dampings:
                rows.append((
                    brake, damping, self._stiffest(brake, damping),
                    held.critical_stiffness(damping), alone.critical_stiffness(damping),
                    max(passive_stiffness(settings.physical(brake), damping, period), 0.0),
                ))  # fmt: skip
        names = ("brake_command", "damping", "stiffest", "theory_held", "theory_free", "passive")
        units = ("V", "N*m*s/rad", *(4 * ["N*m/rad"]))
        return Table(
            "boundary", "Stiffest stable wall", dict(zip(names, np.array(rows).T, strict=True)),
            dict(zip(names, units, strict=True)),
        )  # fmt: skip

    def _cells(self) -> Table:
        """Every wall that was visited."""
        rows = [
            (v.cell.brake, v.cell.stiffness, v.cell.damping, v.amplitude, float(self._stable(v)))
            for v in self._visits
        ]
        names = {"brake_command": "V", "stiffness": "N*m/rad", "damping": "N*m*s/rad",
                 "amplitude": "rad", "stable": ""}  # fmt: skip
        columns = dict(zip(names, np.array(rows).T, strict=True))
        units = {name: unit for name, unit in names.items() if unit}
        return Table("walls", "Walls", columns, units, printed=False)

    def _figure(self, k: int, brake: float) -> Heatmap:
        """Oscillation over damping and stiffness, with the bounds of theory."""
        settings = self._settings
        values = np.full((len(settings.stiffnesses), len(settings.dampings)), math.nan)
        for v in self._visits:
            if v.cell.brake == brake:
                place = settings.stiffnesses.index(v.cell.stiffness)
                shown = min(v.amplitude, 2.0 * self._limit)
                values[place, settings.dampings.index(v.cell.damping)] = 1e3 * shown
        return Heatmap(
            "z_width" if k == 0 else f"z_width_{k + 1}",
            f"Oscillation of the wall, brake at {brake:g} V; it rings above "
            f"{1e3 * self._limit:.3g} mrad",
            Axis("damping", "N*m*s/rad"), Axis("stiffness", "N*m/rad"), Axis("amplitude", "mrad"),
            np.array(settings.dampings), np.array(settings.stiffnesses), values,
            _theory(settings, brake),
        )  # fmt: skip

    def _remarks(self) -> tuple[str, ...]:
        left = sum(math.isinf(v.amplitude) for v in self._visits)
        skipped = len(self._settings.cells) - len(self._visits)
        loose = sum(v.contact <= 0.5 for v in self._visits)
        speed = self._settings.ringing.speed
        remarks = (
            (left, f"Walls left at once, at {speed:g} rad/s"),
            (skipped, "Walls not visited, stiffer than one that rang at the same damping"),
            (loose, "Walls without contact while watched, which do not count as stable"),
        )
        return tuple(f"{what}: {n}." for n, what in remarks if n)
