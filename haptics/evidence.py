"""What speaks for an experiment with a torque controller before it runs: trials, and margins.

Each trial has an actuator from the identification's uncertainty, and a hand from 1/4 to 4 times
that of (A.2); see ``haptics.trial`` for what lies between them and the controller. Amplifiers end
where a variant of the model with limits has it.
"""

import math
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
from haptics.program import compiled_trial, step_matrices, stiff_part
from sysid.threads import one_thread

BoolArray = NDArray[np.bool_]

HAND = (0.16, 0.0179)  # N*m/rad, N*m*s/rad, by (A.2)
HAND_RANGE = 4.0  # factor either way
STIFFEST_HAND = 40.0  # N*m/rad, of those that walls are promised for: 250 times (A.2)'s
NOISE = (5e-3, 5e-3, 7e-3)  # A, A, N*m: rms of the sensors

_LONGEST_STEP = 1.6e-4  # s; an amplifier at its end is faster than its linear part
_STILL = 0.25  # s at the end over which the shaft is to be at rest
_CALM = 1.0  # rad/s rms that an encoder's counts and the sensors' noise leave at most
_FAMILY = 24  # members whose margins are computed
_TRIPS = ("current_motor", "current_brake", "speed", "torque")
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

    @property
    def left(self) -> BoolArray:
        """Which trials left their wall."""
        gone: BoolArray = self.results[:, trial.LEFT] > 0.0
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
    draws: int, seed: int = 0,
) -> Outcomes:  # fmt: skip
    """Trials of scenes in turn, each with a plausible actuator and hand."""
    model, control = controller.model, controller.control
    rng = np.random.default_rng(seed)
    actuators = controller.plausible(draws, seed)
    if not len(actuators):
        actuators = controller.parameters[None]
    time = program.step.time
    steps = max(1, math.ceil(time / _LONGEST_STEP))
    A = np.stack([stiff_part(model, p) for p in actuators])
    matrices = step_matrices(A, np.full(len(A), time / steps))
    hands = np.array(HAND) * HAND_RANGE ** rng.uniform(-1.0, 1.0, (draws, 1))
    names = model.state_names
    omega, _, theta = SHAFT
    states = [names.index(k) for k in (omega, theta, "current_motor", "current_brake")]
    inputs = ("applied_voltage_motor", "applied_voltage_brake", "torque")
    places = np.array(states + [model.input_names.index(k) for k in inputs])
    ends = limits.current_motor, limits.current_brake, limits.speed, limits.torque
    bounds = np.array([*ends, *limits.motor, *limits.brake])
    c, p = np.array(program.constants), np.array(program.parameters)
    run, results = compiled_trial(model, program.entry), np.zeros((draws, trial.RESULT))
    for k in range(draws):
        scene, place = scenes[k % len(scenes)], k % len(actuators)
        noise = rng.standard_normal((len(scene.reference), 3)) * NOISE
        walled = scene.wall is not None
        wall = np.zeros(trial.WALL) if scene.wall is None else scene.wall
        last = round(_STILL / time)
        run(
            scene.reference, scene.share, scene.path, noise, wall, walled, bounds,
            limits.count, control.ahead, last, places, steps, time,
            np.zeros(program.n_states), c, p, actuators[place], matrices[place],
            model.initial_state, np.zeros(len(model.inputs)), np.array([*hands[k], 0.0, 0.0]),
            np.zeros((6, len(names))), np.zeros((control.ahead + 1, 2)), results[k],
        )  # fmt: skip
    return Outcomes(results, hands)


@one_thread()
def family_margins(controller: TunedController, seed: int = 0) -> list[LoopMargins]:
    """Margins of plausible actuators in hands of both ends and the middle, by branch."""
    control = controller.control
    actuators = np.concatenate(
        [controller.parameters[None], controller.plausible(_FAMILY // 6 - 1, seed)]
    )
    program = control.program(controller.model, controller.parameters)
    laws_of = {branch: LinearLaw.of(program, controller.model, branch) for branch in _BRANCHES}
    return [
        loop_margins(
            laws_of[branch],
            dynamics,
            branch,
            (HAND[0] * scale, HAND[1] * scale),
            1.0 / control.sample_rate,
            control.ahead,
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
    outcomes: Outcomes, margins: list[LoopMargins], spread: bool, *, walls: bool = False
) -> Evidence:
    """What trials and margins come to, and whether they speak against the experiment.

    walls: whether not to come to rest is what the experiment is to find out.
    """
    results, tripped = outcomes.results, outcomes.tripped
    restless = outcomes.restless | outcomes.left
    count = len(results)
    peak = max(margin.sensitivity for margin in margins)
    largest = results[:, trial.MOST : trial.MOST + 4].max(axis=0)
    units = ("A", "A", "rad/s", "N*m")
    numbers = [
        Number("trials", count, "1", meaning="each with an actuator and a hand of its own"),
        Number("tripped", float(tripped.sum()), "1", meaning="of them, by any limit"),
        Number("restless", float(restless.sum()), "1", meaning="that did not come to rest"),
        Number("disk_margin", min(m.disk for m in margins), "1", meaning="least of the family"),
        *([Number("sensitivity", peak, "1", meaning="largest |S|")] if math.isfinite(peak) else []),
        *(
            Number(f"largest_{name}", float(most), unit, meaning="of all trials")
            for name, most, unit in zip(_TRIPS, largest, units, strict=True)
        ),
    ]
    unstable = sum(not margin.stable for margin in margins)
    remarks = []
    if not spread:
        remarks.append("No uncertainty of the actuator is known: the trials differ by the hand.")
    if unstable:
        remarks.append(
            f"{unstable} of {len(margins)} linear loops are unstable: disk margin 0, |S| infinite."
        )
    refusals = [
        f"{number:.0f} of {count} simulated trials trip {name}"
        for name, number in zip(_TRIPS, tripped, strict=True)
        if number
    ]
    if restless.any() and not walls:
        refusals.append(f"{restless.sum()} of {count} do not come to rest")
    return Evidence(tuple(numbers), tuple(remarks), "; ".join(refusals))
