"""A virtual wall, spring and damper, at each point of a grid: which of them are stable."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from daq.experiment import Controller, Evidence, Plan, TripLimits
from daq.findings import Chart, Findings, Number, Series
from daq.hal import FloatArray, Samples
from daq.progress import Watch, ignore
from haptics.evidence import HAND_RANGE, STIFFEST_HAND, Scene
from haptics.passivity import Hands, Passivity, Tracker, UnknownPassivityError
from haptics.program import HAND
from protocols.analysis.results import DAMPING, STIFFNESS
from protocols.analysis.walls import WallFindings, WallTheory, visited
from protocols.control.loop import command_bounds, tracker_gains
from protocols.control.wall import WallRenderer, WallSettings

_ACTUATORS = 100  # whose passivity is computed
_LEAN = 0.5  # rad, by which a hand leans beyond the wall


class VirtualWall(WallSettings):
    """A wall of each stiffness and damping in turn; which ring, with the brake and without."""

    @property
    def theory(self) -> WallTheory:
        """What is to be expected of the walls."""
        return WallTheory(self)

    def plan(self) -> Plan:
        """The longest that it can take, and what (1.1) says of the grid."""
        if any(b <= a for a, b in zip(self.stiffnesses, self.stiffnesses[1:], strict=False)):
            raise ValueError("stiffnesses: write them rising, so that soft walls come first")
        self._check_times()
        cell = 2.0 * self.rest.time + self.tap.time + self.ringing.watch
        seconds = self.patience + len(self.cells) * cell + self.rest.time
        n_samples = self.samples_in(seconds, "stiffnesses")
        bounds = command_bounds(self.motor_limit, self.brake_commands)
        passivity = (self._passivity(brake) for brake in self.brake_commands)
        remarks = (
            *passivity,
            "All others are tried as well: hold the handle firmly, and be ready to let go. A "
            "simulated hand is in hand.yaml.",
        )
        if self.is_controlled:
            lowest, highest = self.bounds()
            highest[1] = max(highest[1], *self.brake_commands)
            bounds, remarks = (lowest, highest), (*self.controller_remarks(), *remarks)
        return Plan(n_samples, *bounds, remarks=remarks)

    def preview(self) -> Chart:
        """The walls that will be tried, beside what theory says of them."""
        stiff, damped = np.meshgrid(self.stiffnesses, self.dampings)
        walls = Series("walls to be tried", damped.ravel(), stiff.ravel(), style="points")
        brake = self.brake_commands[0]
        title = f"Walls to be tried, and theory with the brake at {brake:g} V"
        series = (walls, *self.theory.bounds(brake))
        return Chart("walls", title, DAMPING, STIFFNESS, series)

    def scenes(self) -> list[Scene]:
        """A hand that leans against each of the walls, and its tap."""
        time = 1.0 / self.sample_rate
        contact, ramp = round(0.6 / time), round(0.4 / time)
        tapped = contact + ramp
        n = tapped + round((self.tap.time + self.ringing.watch) / time)
        lean = np.clip(np.arange(n + 1) * time / 0.4, 0.0, 1.0) * (self.position + _LEAN)
        alpha, beta = tracker_gains(self.speed_filter, time)
        rest, tap = self.rest, self.tap
        taps = tap.torque, tapped, tapped + round(tap.time / time)
        return [
            Scene(
                np.zeros(n), np.ones(n), lean,
                np.array([
                    cell.stiffness, cell.damping, self.position, cell.brake, alpha, beta / time,
                    *taps, rest.stiffness, rest.damping, self.ringing.speed,
                ]),
            )
            for cell in self.cells
        ]  # fmt: skip

    def evidence(self, limits: TripLimits, draws: int, watch: Watch = ignore) -> Evidence | None:
        """The same as of any controller's experiment, and which walls are passive."""
        evidence = super().evidence(limits, draws, watch)
        if evidence is None:
            return None
        try:
            numbers, remarks = self._promises(limits.count)
        except UnknownPassivityError as error:
            return replace(evidence, remarks=(*evidence.remarks, f"{error}."))
        if evidence.refusal:
            passive, held = (number.value for number in numbers)
            promises = (
                f"walls up to {passive:.3g} N*m/rad are passive; without damping up to "
                f"{held:.3g} N*m/rad they rest in hands that damp"
            )
            return replace(evidence, refusal=f"{evidence.refusal}; {promises}")
        return replace(
            evidence,
            numbers=(*evidence.numbers, *numbers),
            remarks=(*evidence.remarks, *remarks),
        )

    def _promises(self, count: float) -> tuple[tuple[Number, ...], tuple[str, ...]]:
        """Which walls are passive, and which rest in hands that damp.

        count: angle of one of the encoder [rad]. Raises UnknownPassivityError.
        """
        tuned = self.tuned_controller
        tracker = Tracker(*tracker_gains(self.speed_filter, 1.0 / self.sample_rate))
        drawn = tuned.plausible(_ACTUATORS)
        actuators = np.concatenate([tuned.parameters[None], drawn])
        hands = Hands(HAND[1] / HAND_RANGE, STIFFEST_HAND)
        promise = Passivity(tuned, tracker, actuators).promise(count)
        springs = Passivity(tuned, tracker, actuators, hands).springs_promised()
        sure = "with 95 %" if len(drawn) else "if the parameters are right"
        any_hand = (
            f"Walls up to {promise.stiffness:.3g} N*m/rad with a damping of "
            f"{promise.damping:.2g} N*m*s/rad are passive {sure}, in any passive hand, with the "
            "brake off or at a constant current."
            if promise.stiffness > 0.0
            else "No wall is passive in any passive hand: see friction_share and inertia_share."
        )
        closed_forms = (
            f"Colgate and Schenkel without delay: {promise.colgate:.3g}; Abbott and Okamura: "
            f"{promise.abbott:.3g} N*m/rad."
        )
        damps = (
            f"of (A.2)'s form (mass, damper and spring side by side) that damps by "
            f"{hands.damping:.2g} N*m*s/rad or more, a quarter of (A.2)'s, and is no stiffer than "
            f"{hands.stiffness:g} N*m/rad, with the brake off"
        )
        damped = (
            f"Walls without damping up to {springs:.3g} N*m/rad come to rest {sure}, entered and "
            f"left, in any hand {damps}."
            if springs > 0.0
            else f"No wall is promised to come to rest in a hand {damps}, either."
        )
        remarks = f"{any_hand} {closed_forms}", damped
        meanings = "of walls in any hand", f"of springs in hands that damp by {hands.damping:.2g}"
        numbers = (
            Number("passive_stiffness", promise.stiffness, "N*m/rad", meaning=meanings[0]),
            Number("held_stiffness", springs, "N*m/rad", meaning=meanings[1]),
        )
        return numbers, remarks

    def controller(self) -> Controller:
        """The renderer of the walls."""
        return WallRenderer(self)

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """Which walls rang, beside what theory says."""
        visits = visited(self, samples, extra)
        if not visits:
            raise ValueError("no wall was watched to its end; did a hand lean against it?")
        return WallFindings(self, self.theory, visits).findings()

    def _check_times(self) -> None:
        """ValueError for times in which too few samples come to tell anything."""
        for key, seconds, fewest in (
            ("rest.time", self.rest.time, 2),
            ("tap.time", self.tap.time, 1),
            ("ringing.watch", self.ringing.watch, 40),
        ):
            if round(seconds * self.sample_rate) < fewest:
                raise ValueError(
                    f"{key}: {seconds:g} s is less than {fewest} samples at "
                    f"{self.sample_rate:g} Hz; make it {fewest / self.sample_rate:.3g} s at least"
                )

    def _passivity(self, brake: float) -> str:
        """Which of the walls are passive."""
        theory = self.theory
        cells = [cell for cell in self.cells if cell.brake == brake]
        passive = sum(x.stiffness < theory.passive_stiffness(brake, x.damping) for x in cells)
        name, with_brake = ("(1.2)", f", brake at {brake:g} V") if brake else ("(1.1)", "")
        total = len(self.cells) // len(self.brake_commands)
        return (
            f"Passive by {name}{with_brake}: b = {theory.damping(brake):.3g} N*m*s/rad > K T / 2 + "
            f"|B| holds up to K = {theory.passive_stiffness(brake, 0.0):.3g} N*m/rad without "
            f"damping; {passive} of the {total} walls are."
        )
