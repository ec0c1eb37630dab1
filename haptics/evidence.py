"""What speaks for an experiment with a torque controller before it runs: trials, and margins.

Each trial has an actuator from the identification's uncertainty, and a hand from 1/4 to 4 times
that of (A.2); see ``haptics.trial`` for what lies between them and the controller. Amplifiers end
where a variant of the model with limits has it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.experiment import Evidence, TripLimits
from daq.findings import Number
from daq.hal import FloatArray
from daq.lookup.controllers import TunedController
from daq.torque import LawProgram
from haptics import trial
from haptics.dynamics import SHAFT, ActuatorDynamics
from haptics.linear_loop import LinearLaw, LoopMargins, loop_margins
from haptics.operating_points import Branch
from haptics.program import HAND, trial_kernels
from sysid.engine.scheme import LANES, work_area
from sysid.threads import one_thread

BoolArray = NDArray[np.bool_]

HAND_RANGE = 4.0  # factor either way
STIFFEST_HAND = 40.0  # N*m/rad, of those that walls are promised for: 250 times (A.2)'s
NOISE = (5e-3, 5e-3, 7e-3)  # A, A, N*m: rms of the sensors

_LONGEST_STEP = 2.5e-4  # s; of hysteresis at 100 rad/s, and of amplifiers at their ends
_STILL = 0.25  # s at the end over which the shaft is to be at rest
_CALM = 1.0  # rad/s rms that an encoder's counts and the sensors' noise leave at most
_PARTS = 10  # of the trials, after which they are weighed
_FAMILY = 24  # members whose margins are computed
_TRIPS = ("current_motor", "current_brake", "speed", "torque")
LEAST_DISK = 0.2  # disk margin below which an experiment is warned of
_NO_SPREAD = "No uncertainty of the actuator is known: the trials differ by the hand."
_CURE = (
    "A lower friction_share, yield_share, inertia_share or acceleration_filter, or lqg in place of "
    "feedforward, has more margin."
)
_BRANCHES: tuple[Branch, ...] = ("within yield", "sliding forwards")


@dataclass(frozen=True)
class Scene:
    """What a trial asks: the torque on the hand and the part of the commands, (n,) each.

    path: angles of the hand at the samples and behind the last, (n + 1,) [rad]. wall: numbers as
    of ``haptics.trial``; None: none.
    """

    reference: FloatArray
    share: FloatArray
    path: FloatArray
    wall: FloatArray | None = None


@dataclass
class Outcomes:
    """Results of trials, (n, ``trial.RESULT``), and their hands, (n, 2)."""

    results: FloatArray
    hands: FloatArray

    @property
    def tripped(self) -> FloatArray:
        """How many trials each limit ended, (4,)."""
        return np.array([np.sum(self.results[:, trial.TRIPPED] == k + 1) for k in range(4)])

    def failures(self, *, walls: bool = False) -> dict[str, int]:
        """How many trials speak against the experiment, by what they do; nothing that none does.

        walls: whether not to come to rest is what the experiment is to find out.
        """
        counts = {
            f"simulated trials trip {name}": int(number)
            for name, number in zip(_TRIPS, self.tripped, strict=True)
        }
        if not walls:
            counts["do not come to rest"] = int((self.restless | self.left).sum())
        return {what: number for what, number in counts.items() if number}

    @property
    def left(self) -> BoolArray:
        """Which trials ran to the end and left their wall."""
        ended = self.results[:, trial.TRIPPED] == 0.0
        gone: BoolArray = ended & (self.results[:, trial.LEFT] > 0.0)
        return gone

    @property
    def restless(self) -> BoolArray:
        """Which trials ran to the end and did not come to rest."""
        ended = self.results[:, trial.TRIPPED] == 0.0
        moving: BoolArray = ended & ~(self.results[:, trial.AT_REST] <= _CALM)
        return moving


@one_thread()
def run_trials(
    controller: TunedController, program: LawProgram, scenes: list[Scene], limits: TripLimits,
    draws: int, seed: int = 0, *, enough: Callable[[Outcomes], bool] = lambda outcomes: False,
) -> Outcomes:  # fmt: skip
    """Trials of scenes in turn, each with a plausible actuator and hand.

    enough: whether the trials so far decide, asked after each tenth of them and at the end; then no
    more are made.
    """
    rng = np.random.default_rng(seed)
    actuators = controller.plausible(draws, seed)
    if not len(actuators):
        actuators = controller.parameters[None]
    hands = np.array(HAND) * HAND_RANGE ** rng.uniform(-1.0, 1.0, (draws, 1))
    blocks, results = TrialBlocks(controller, program, limits), np.empty((0, trial.RESULT))
    part = LANES * math.ceil(draws / _PARTS / LANES)
    for first in range(0, draws, LANES):
        rows = np.arange(first, min(first + LANES, draws))
        stretch = [scenes[k % len(scenes)] for k in rows]
        block = blocks.run(stretch, actuators[rows % len(actuators)], hands[rows], rng)
        results = np.concatenate([results, block])
        outcomes = Outcomes(results, hands[: len(results)])
        weighed = len(results) % part == 0 or len(results) == draws
        if weighed and enough(outcomes):
            break
    return outcomes


class TrialBlocks:
    """Blocks of up to ``LANES`` trials of one law."""

    def __init__(
        self, controller: TunedController, program: LawProgram, limits: TripLimits
    ) -> None:
        self._kernels = trial_kernels(controller.model, program.entry)
        self._program, self._ahead = program, controller.control.ahead
        self._count = limits.count
        ends = limits.current_motor, limits.current_brake, limits.speed, limits.torque
        self._limits = np.array([*ends, *limits.motor, *limits.brake])
        model, kernel = self._kernels.model, self._kernels.plants.kernel
        omega, _, theta = SHAFT
        states = (omega, theta, "current_motor", "current_brake")
        inputs = ("applied_voltage_motor", "applied_voltage_brake", "hand_theta", "hand_omega")
        self._places = np.array(
            [model.state_names.index(name) for name in states]
            + [model.input_names.index(name) for name in inputs]
            + [kernel.n_inputs]
        )

    def run(
        self,
        scenes: list[Scene],
        actuators: FloatArray,
        hands: FloatArray,
        rng: np.random.Generator,
    ) -> FloatArray:
        """Results of trials, (m, ``trial.RESULT``); actuators (m, n_parameters), hands (m, 2)."""
        program, plants, model = self._program, self._kernels.plants, self._kernels.model
        m, kernel, time = len(scenes), plants.kernel, program.step.time
        lanes = np.arange(LANES) % m
        parameters = np.ascontiguousarray(np.hstack([actuators, hands])[lanes].T)
        work, inputs = work_area(kernel.work_rows * LANES), work_area(kernel.input_rows * LANES)
        inputs[:] = 0.0
        initial = model.initial_state
        steps = max(1, math.ceil(time / _LONGEST_STEP))
        plants.prepare(
            work, work.reshape(-1, LANES), kernel.tables, np.tile(initial[:, None], LANES),
            parameters, time / steps,
        )  # fmt: skip
        noise = np.stack([rng.standard_normal((len(s.reference), 3)) * NOISE for s in scenes])
        none, results = np.zeros(trial.WALL), np.zeros((m, trial.RESULT))
        tracker = np.zeros((m, trial.TRACKER))
        tracker[:, trial.TRACKED] = initial[self._places[trial.THETA]]
        self._kernels.run(
            np.stack([s.reference for s in scenes]), np.stack([s.share for s in scenes]),
            np.stack([s.path for s in scenes]), noise,
            np.stack([none if s.wall is None else s.wall for s in scenes]), self._limits, hands,
            self._count, self._ahead, round(_STILL / time), self._places, steps, time, work,
            inputs, np.zeros((m, program.n_states)), np.array(program.constants),
            np.array(program.parameters), tracker, np.zeros((m, self._ahead + 1, 2)), results,
        )  # fmt: skip
        return results


@dataclass(frozen=True)
class FamilyLoop:
    """Margins of one loop of a family; hand: in parts of (A.2)'s."""

    branch: Branch
    hand: float
    margins: LoopMargins


@one_thread()
def family_margins(controller: TunedController, seed: int = 0) -> list[FamilyLoop]:
    """Margins of plausible actuators in hands of both ends and the middle, by branch."""
    control = controller.control
    actuators = np.concatenate(
        [controller.parameters[None], controller.plausible(_FAMILY // 6 - 1, seed)]
    )
    program = control.program(controller.model, controller.parameters)
    laws_of = {branch: LinearLaw.of(program, controller.model, branch) for branch in _BRANCHES}
    time, ahead = 1.0 / control.sample_rate, control.ahead
    return [
        FamilyLoop(
            branch,
            scale,
            loop_margins(
                laws_of[branch], dynamics, branch, (HAND[0] * scale, HAND[1] * scale), time, ahead
            ),
        )
        for dynamics in (ActuatorDynamics(controller.model, p) for p in actuators)
        for branch in _BRANCHES
        for scale in (1.0 / HAND_RANGE, 1.0, HAND_RANGE)
    ]


def hand_path(n: int, time: float, speed: float, rng: np.random.Generator) -> FloatArray:
    """A wrist that moves to and fro at up to ``speed`` [rad/s] and stops, (n + 1,) [rad]."""
    t = np.arange(n + 1) * time
    frequency = rng.uniform(0.5, 2.5, 3)
    waves = np.sin(2.0 * np.pi * np.outer(frequency, t) + rng.uniform(0.0, 6.3, (3, 1)))
    waves /= 2.0 * np.pi * frequency[:, None]
    rise = np.clip(np.minimum(t / 0.2, (t[-1] - t - 2.0 * _STILL) / 0.3), 0.0, 1.0)
    path = (0.5 - 0.5 * np.cos(np.pi * rise)) * waves.sum(axis=0)
    fastest = np.abs(np.diff(path)).max() / time
    moved: FloatArray = path * speed / max(fastest, 1e-9)
    return moved


def fading(values: FloatArray, time: float) -> FloatArray:
    """A reference that ends softly, and is zero until the shaft must be at rest."""
    left = (len(values) - np.arange(len(values))) * time
    faded: FloatArray = values * np.clip((left - 2.0 * _STILL) / 0.1, 0.0, 1.0)
    return faded


def weigh(
    outcomes: Outcomes, family: list[FamilyLoop], draws: int, spread: bool, *, walls: bool = False
) -> Evidence:
    """What trials and margins come to, and whether they speak against the experiment.

    draws: of trials that were asked for. spread: whether the actuators differ. walls: as of
    ``Outcomes.failures``.
    """
    results, tripped = outcomes.results, outcomes.tripped
    restless = outcomes.restless | outcomes.left
    count = len(results)
    least = min(family, key=lambda member: member.margins.disk)
    peak = max(member.margins.sensitivity for member in family)
    largest = results[:, trial.MOST : trial.MOST + 4].max(axis=0)
    units = ("A", "A", "rad/s", "N*m")
    numbers = [
        Number("trials", count, "1", meaning="each with an actuator and a hand of its own"),
        Number("tripped", float(tripped.sum()), "1", meaning="of them, by any limit"),
        Number("restless", float(restless.sum()), "1", meaning="that did not come to rest"),
        Number("disk_margin", least.margins.disk, "1", meaning="least of the family"),
        *([Number("sensitivity", peak, "1", meaning="largest |S|")] if math.isfinite(peak) else []),
        *(
            Number(f"largest_{name}", float(most), unit, meaning="of all trials")
            for name, most, unit in zip(_TRIPS, largest, units, strict=True)
        ),
    ]
    remarks = [] if spread else [_NO_SPREAD]
    if least.margins.disk < LEAST_DISK:
        remarks.append(_warning(least, sum(not member.margins.stable for member in family)))
    first = "" if count == draws else "the first "
    refusals = [
        f"{number:.0f} of {first}{count} {what}"
        for what, number in outcomes.failures(walls=walls).items()
    ]
    return Evidence(tuple(numbers), tuple(remarks), "; ".join(refusals))


def _warning(least: FamilyLoop, unstable: int) -> str:
    """What a small disk margin means, by the loop that has it."""
    where = f"{least.branch}, in a hand of {least.hand:g} times that of (A.2)"
    if unstable:
        text = (
            f"Warning: {unstable} loops of the family are unstable as linear ones (one of them "
            f"{where}): disk margin 0, |S| infinite. In the trials friction held them."
        )
    else:
        disk = least.margins.disk
        gain, phase = 2.0 * disk / (2.0 + disk), 2.0 * math.atan(0.5 * disk)
        text = (
            f"Warning: a disk margin of {disk:.2g} ({where}): a gain that is off by "
            f"{100.0 * gain:.2g} % or a phase by {math.degrees(phase):.2g} degrees may make this "
            "loop swing. The trials have such actuators as the identification leaves open, and "
            "nothing that the model lacks."
        )
    return f"{text} {_CURE}"
