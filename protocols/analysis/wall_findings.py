"""Findings of a run of virtual walls: which of them rang, beside what theory says."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from daq.findings import Axis, Findings, Heatmap, Number, Table
from daq.hal import FloatArray, Samples
from protocols.analysis.passivity import WallTheory
from protocols.analysis.results import table_of_rows
from protocols.control.wall import ABORTED, WATCHED, Cell, WallSettings, oscillation

_WHOLE = 0.9  # of the time watched: samples may be lost at its ends
_IN_CONTACT = 0.5  # of the time watched, at most, of a wall that does not count


@dataclass(frozen=True)
class Visit:
    """A cell, its oscillation [rad], infinite where it was left at once, and time in contact."""

    cell: Cell
    amplitude: float
    contact: float


def visited(
    settings: WallSettings, samples: Samples, extra: Mapping[str, FloatArray]
) -> list[Visit]:
    """The cells that were watched to their end or left at once."""
    visits = []
    for index, cell in enumerate(settings.cells):
        state = np.where(extra["cell"] == index, extra["state"], math.nan)
        watched = state == WATCHED
        time, depth = samples.time[watched], extra["penetration"][watched]
        if (state == ABORTED).any():
            visits.append(Visit(cell, math.inf, math.nan))
        elif watched.any() and np.ptp(time) > _WHOLE * 0.5 * settings.ringing.watch:
            visits.append(Visit(cell, oscillation(time, depth), float(np.mean(depth > 0.0))))
    return visits


@dataclass(frozen=True)
class WallFindings:
    """Which walls are stable; visits: at least one."""

    settings: WallSettings
    theory: WallTheory
    visits: list[Visit]

    def findings(self) -> Findings:
        """The stiffest walls, tables of them and of all, and a map for each brake command."""
        brakes = list(enumerate(self.settings.brake_commands, start=1))
        numbers = tuple(self._number(place, brake) for place, brake in brakes)
        maps = tuple(self._map(place, brake) for place, brake in brakes)
        tables = self._boundary_table(), self._wall_table()
        return Findings(numbers, tables, maps, {}, self._remarks())

    def _is_stable(self, visit: Visit) -> bool:
        return visit.amplitude <= self.settings.ringing.amplitude and visit.contact > _IN_CONTACT

    def _stiffest(self, brake: float, damping: float) -> float:
        """The stiffest wall below the first that rang [N*m/rad]; 0 where the softest rang."""
        stiffest = 0.0
        for visit in self.visits:
            if (visit.cell.brake, visit.cell.damping) == (brake, damping):
                if not self._is_stable(visit):
                    break
                stiffest = visit.cell.stiffness
        return stiffest

    def _number(self, place: int, brake: float) -> Number:
        """The stiffest wall of all dampings."""
        stiffest = max(self._stiffest(brake, damping) for damping in self.settings.dampings)
        meaning = f"stiffest wall that was stable, brake at {brake:g} V"
        return Number(_numbered("stiffest", place), stiffest, "N*m/rad", meaning=meaning)

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

    def _map(self, place: int, brake: float) -> Heatmap:
        """Oscillation over damping and stiffness, with the bounds of theory."""
        stiffnesses, dampings = self.settings.stiffnesses, self.settings.dampings
        values = np.full((len(stiffnesses), len(dampings)), math.nan)
        for visit in self.visits:
            if visit.cell.brake == brake:
                row = stiffnesses.index(visit.cell.stiffness)
                shown = min(visit.amplitude, 2.0 * self.settings.ringing.amplitude)
                values[row, dampings.index(visit.cell.damping)] = 1e3 * shown
        return Heatmap(
            _numbered("z_width", place),
            f"Oscillation of the wall, brake at {brake:g} V; it rings above "
            f"{1e3 * self.settings.ringing.amplitude:.3g} mrad",
            Axis("damping", "N*m*s/rad"),
            Axis("stiffness", "N*m/rad"),
            Axis("amplitude", "mrad"),
            np.array(dampings),
            np.array(stiffnesses),
            values,
            self.theory.bounds(brake, dampings, stiffnesses[-1]),
        )

    def _remarks(self) -> tuple[str, ...]:
        left = sum(math.isinf(visit.amplitude) for visit in self.visits)
        skipped = len(self.settings.cells) - len(self.visits)
        loose = sum(visit.contact <= _IN_CONTACT for visit in self.visits)
        speed = self.settings.ringing.speed
        remarks = (
            (left, f"Walls left at once, at {speed:g} rad/s"),
            (skipped, "Walls not visited, stiffer than one that rang at the same damping"),
            (loose, "Walls without contact while watched, which do not count as stable"),
        )
        return tuple(f"{walls}: {count}." for count, walls in remarks if count)


def _numbered(name: str, place: int) -> str:
    """The name of the first, and with its place of each further brake command."""
    return name if place == 1 else f"{name}_{place}"
