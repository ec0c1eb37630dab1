"""Stability of rendered walls: by passivity, by eigenvalues, and as found in a run of them."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from daq.findings import Axis, Findings, Heatmap, Number, Series, Table
from daq.hal import FloatArray, Samples
from protocols.analysis.results import DAMPING, STIFFNESS, table_of_rows
from protocols.control.loop import tracker_gains
from protocols.control.wall import ABORTED, WATCHED, Cell, WallSettings, oscillation

_STIFFEST = 1e4  # N*m/rad, beyond what any motor renders
_BISECTIONS = 32
_CURVE_POINTS = 60  # of a bound in a figure
_COMPLETE = 0.9  # share of the time watched: samples may be lost at its ends
_MIN_CONTACT = 0.5  # share of the time watched; a wall with no more does not count as stable


@dataclass(frozen=True)
class SampledWall:
    """The sampled loop of a shaft that touches a rendered wall.

    inertia [kg*m^2], damping [N*m*s/rad], stiffness [N*m/rad]: of shaft and hand. The torque, made
    every ``period`` [s], acts ``ahead`` ticks later. bandwidth [Hz]: of the speed's tracker.
    """

    inertia: float
    damping: float
    stiffness: float
    period: float
    ahead: int
    bandwidth: float

    def spectral_radius(self, stiffness: float, damping: float) -> float:
        """Spectral radius of the loop with this wall; the loop is stable below 1.

        The shaft is discretised exactly between samples. States: angle and speed of the shaft,
        angle and speed of the tracker, and the last ``ahead`` torques computed.
        """
        n = 4 + self.ahead
        Phi, Gamma = self._shaft
        alpha, beta = tracker_gains(self.bandwidth, self.period)
        # The tracker as it stands after the sample k, from its state after k - 1 and theta_k.
        tracker = np.array(
            [[1.0 - alpha, (1.0 - alpha) * self.period], [-beta / self.period, 1.0 - beta]]
        )
        gain = np.array([alpha, beta / self.period])
        loop = np.zeros((n, n))
        loop[:2, :2] = Phi
        loop[:2, -1] = Gamma
        loop[2:4, 0], loop[2:4, 2:4] = gain, tracker
        loop[4] = -damping * loop[3]  # the wall damps the tracked speed
        loop[4, 0] -= stiffness
        for late in range(1, self.ahead):
            loop[4 + late, 3 + late] = 1.0
        # The torque that acts from a sample on is the one computed ``ahead`` samples before.
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def critical_stiffness(self, damping: float) -> float:
        """The stiffness above which walls of this damping are unstable [N*m/rad]; 0 if all are."""
        low, high = 0.0, _STIFFEST
        if self.spectral_radius(1e-9, damping) >= 1.0:
            return 0.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if self.spectral_radius(middle, damping) < 1.0:
                low = middle
            else:
                high = middle
        return low

    @functools.cached_property
    def _shaft(self) -> tuple[FloatArray, FloatArray]:
        """Phi and Gamma of J dω/dt = torque - b ω - k θ, discretised with the torque held."""
        from scipy.linalg import expm

        augmented = np.zeros((3, 3))
        augmented[0, 1] = 1.0
        augmented[1] = np.array([-self.stiffness, -self.damping, 1.0]) / self.inertia
        step = expm(augmented * self.period)
        return step[:2, :2], step[:2, 2]


@dataclass(frozen=True)
class WallTheory:
    """Stability and passivity of a grid of walls, by the brake's command [V]."""

    settings: WallSettings

    def damping(self, brake: float) -> float:
        """b + b_passive of (1.2) [N*m*s/rad]."""
        return self.settings.body.damping + self.settings.body.brake_damping * abs(brake)

    def loop(self, brake: float, hand: bool) -> SampledWall:
        """The sampled loop around the shaft, with the hand or without."""
        settings, body = self.settings, self.settings.body
        hand_damping, stiffness = (body.hand_damping, body.hand_stiffness) if hand else (0.0, 0.0)
        damping = self.damping(brake) + hand_damping
        rendering = 1.0 / settings.sample_rate, settings.ahead, settings.speed_filter
        return SampledWall(body.inertia, damping, stiffness, *rendering)

    def passive_stiffness(self, brake: float, damping: float) -> float:
        """Largest K that (1.1), (1.2) call passive with a damping B, b > K T / 2 + |B| [N*m/rad].

        Colgate & Schenkel, "Passivity of a class of sampled-data systems", 1997. Not positive
        where the damping alone is more than b.
        """
        period = 1.0 / self.settings.sample_rate
        return 2.0 * (self.damping(brake) - abs(damping)) / period

    def bounds(self, brake: float) -> tuple[Series, ...]:
        """Largest stiffness over the damping: stable with handle held and free, and passive."""
        dampings, stiffest = self.settings.dampings, self.settings.stiffnesses[-1]
        drawn = np.linspace(min(dampings), max(dampings), _CURVE_POINTS)
        series = []
        for label, hand in (("stable, handle held", True), ("stable, handle free", False)):
            loop = self.loop(brake, hand)
            bound = np.array([loop.critical_stiffness(damping) for damping in drawn])
            series.append(Series(label, drawn, np.where(bound <= stiffest, bound, math.nan)))
        passive = Series(
            "passive: KT/2 + |B| < b" + (" + brake's" if brake else ""),
            np.array([0.0, self.damping(brake)]),
            np.array([self.passive_stiffness(brake, 0.0), 0.0]),
        )
        return (*series, passive)


@dataclass(frozen=True)
class Visit:
    """A cell, its oscillation [rad], infinite if left at once, and its share of time in contact."""

    cell: Cell
    amplitude: float
    contact: float


def visited(
    settings: WallSettings, samples: Samples, extra: Mapping[str, FloatArray]
) -> list[Visit]:
    """Visits of the walls that were watched to the end or left at once."""
    visits = []
    for index, cell in enumerate(settings.cells):
        state = np.where(extra["cell"] == index, extra["state"], math.nan)
        watched = state == WATCHED
        time, depth = samples.time[watched], extra["penetration"][watched]
        if (state == ABORTED).any():
            visits.append(Visit(cell, math.inf, math.nan))
        elif watched.any() and np.ptp(time) > _COMPLETE * 0.5 * settings.ringing.watch:
            visits.append(Visit(cell, oscillation(time, depth), float(np.mean(depth > 0.0))))
    return visits


@dataclass(frozen=True)
class WallFindings:
    """Which walls are stable, by visits (at least one) and by theory."""

    settings: WallSettings
    theory: WallTheory
    visits: list[Visit]

    def findings(self) -> Findings:
        """The stiffest walls, tables of them and of all, and a map for each brake command."""
        numbers, maps = [], []
        for place, brake in enumerate(self.settings.brake_commands, start=1):
            suffix = "" if place == 1 else f"_{place}"
            stiffest = max(self._stiffest(brake, damping) for damping in self.settings.dampings)
            meaning = f"stiffest wall that was stable, brake at {brake:g} V"
            numbers.append(Number(f"stiffest{suffix}", stiffest, "N*m/rad", meaning=meaning))
            maps.append(self._map(f"z_width{suffix}", brake))
        tables = self._boundary_table(), self._wall_table()
        return Findings(tuple(numbers), tables, tuple(maps), {}, self._remarks())

    def _is_stable(self, visit: Visit) -> bool:
        return visit.amplitude <= self.settings.ringing.amplitude and visit.contact > _MIN_CONTACT

    def _stiffest(self, brake: float, damping: float) -> float:
        """The stiffest wall below the first that rang [N*m/rad]; 0 where the softest rang."""
        stiffest = 0.0
        for visit in self.visits:
            if (visit.cell.brake, visit.cell.damping) == (brake, damping):
                if not self._is_stable(visit):
                    break
                stiffest = visit.cell.stiffness
        return stiffest

    def _boundary_table(self) -> Table:
        """By brake command and damping: the stiffest stable wall, and what theory says."""
        rows = []
        for brake in self.settings.brake_commands:
            held, free = (self.theory.loop(brake, hand) for hand in (True, False))
            for damping in self.settings.dampings:
                stable = (held.critical_stiffness(damping), free.critical_stiffness(damping))
                passive = max(self.theory.passive_stiffness(brake, damping), 0.0)
                rows.append((brake, damping, self._stiffest(brake, damping), *stable, passive))
        heading = (
            "brake_command [V], damping [N*m*s/rad], stiffest [N*m/rad], theory_held [N*m/rad], "
            "theory_free [N*m/rad], passive [N*m/rad]"
        )
        return table_of_rows("boundary", "Stiffest stable wall", heading, rows)

    def _wall_table(self) -> Table:
        """Every wall that was visited."""
        rows = [
            (v.cell.brake, v.cell.stiffness, v.cell.damping, v.amplitude, float(self._is_stable(v)))
            for v in self.visits
        ]
        heading = (
            "brake_command [V], stiffness [N*m/rad], damping [N*m*s/rad], amplitude [rad], stable"
        )
        return table_of_rows("walls", "Walls", heading, rows, printed=False)

    def _map(self, name: str, brake: float) -> Heatmap:
        """Oscillation over damping and stiffness, with the bounds of theory."""
        stiffnesses, dampings = self.settings.stiffnesses, self.settings.dampings
        values = np.full((len(stiffnesses), len(dampings)), math.nan)
        for visit in self.visits:
            if visit.cell.brake == brake:
                row = stiffnesses.index(visit.cell.stiffness)
                shown = min(visit.amplitude, 2.0 * self.settings.ringing.amplitude)
                values[row, dampings.index(visit.cell.damping)] = 1e3 * shown
        title = (
            f"Oscillation of the wall, brake at {brake:g} V; it rings above "
            f"{1e3 * self.settings.ringing.amplitude:.3g} mrad"
        )
        axes = DAMPING, STIFFNESS, Axis("amplitude", "mrad")
        plane = np.array(dampings), np.array(stiffnesses), values
        return Heatmap(name, title, *axes, *plane, self.theory.bounds(brake))

    def _remarks(self) -> tuple[str, ...]:
        left = sum(math.isinf(visit.amplitude) for visit in self.visits)
        skipped = len(self.settings.cells) - len(self.visits)
        loose = sum(visit.contact <= _MIN_CONTACT for visit in self.visits)
        speed = self.settings.ringing.speed
        remarks = (
            (left, f"Walls left at once, at {speed:g} rad/s"),
            (skipped, "Walls not visited, stiffer than one that rang at the same damping"),
            (loose, "Walls without contact while watched, which do not count as stable"),
        )
        return tuple(f"{text}: {count}." for count, text in remarks if count)
