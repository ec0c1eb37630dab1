"""Which virtual walls are passive for certain, and which rest in simulation: the Z-width.

python -m benchmarks.walls [--json] [--rates 800 4000] [--hands 24] [--plot z_width.png]
                           [--measure 800] [--fresh 12]

Walls rendered by the static law and by the inverse without what it takes off (friction, inertia),
by the motor alone and with the brake: switched on in contact, or shared by its hysteresis state.
Guaranteed: passive by ``haptics.passivity`` with 95 % over actuators whose parameters are uncertain
by 3 %, in any passive hand. Held: the stiffest without damping that comes to rest, entered and
left, in any hand of (A.2)'s form that damps as a quarter of it and is no stiffer than 40 N*m/rad.
Simulated: the stiffest wall that rests in all of so many hands from 1/4 to 4 times that of (A.2),
each with an actuator of its own, after a tap. The best rendered damping of each. Measured: the
stiffest wall that ``virtual_wall`` finds stable on the simulated rig, electronics, limits and all,
in hands of both ends and the middle; a limit that trips ends it.

``--fresh``: what is promised in hands that damp, against so many plants that were drawn anew. True
is the stiffest wall whose linear loop is stable, without friction, in hands of that damping with a
spring of 0.04 to 40 N*m/rad. And 1000 trials of the promised wall, friction and all, of hands that
come in within 0.02 or 0.3 s, lean by up to 1.5 rad and are tapped with up to 0.6 N*m.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import protocols
from benchmarks._common import arguments, report
from daq import analyse, record, tune
from daq.errors import RunError
from daq.experiment import TripLimits
from daq.hal import FloatArray
from daq.lookup.controllers import TunedController, load_controller
from haptics import trial
from haptics.dynamics import ActuatorDynamics
from haptics.evidence import HAND_RANGE, STIFFEST_HAND, Scene, run_trials
from haptics.linear_loop import LinearLaw, loop_margins
from haptics.passivity import Hands, Passivity, Tracker, UnknownPassivityError
from haptics.program import HAND
from protocols.control.loop import tracker_gains

MODEL = "actuator:parameters=rig"
UNCERTAIN = ("K_m", "J_m", "B_m", "c0", "alpha0", "alpha1", "R_m", "L_m")
SPREAD = 0.03
PLAIN = {"friction_share": 0.0, "inertia_share": 0.0}
MOTOR = {"allocation": "motor"}
VARIANTS: dict[str, dict[str, Any]] = {
    "static, motor": {"controller": "static", **MOTOR},
    "static, brake on in contact": {"controller": "static", "contact": 0.1, **MOTOR},
    "inverse, motor": {"controller": "feedforward", **MOTOR, **PLAIN},
    "inverse, shared": {"controller": "feedforward", "allocation": "heating", **PLAIN},
    "inverse, friction taken off": {"controller": "feedforward", "inertia_share": 0.0, **MOTOR},
}
NOTHING = dict.fromkeys(("guaranteed", "held", "colgate", "abbott"), 0.0)
DAMPINGS = (0.0, 2e-4, 3e-3)  # N*m*s/rad
MEASURED = (0.0, 3e-3)  # of them, in runs
STIFFEST = 400.0  # N*m/rad
GRID = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)  # N*m/rad, of runs
COUNT = 2.0 * math.pi / 8192.0
LIMITS = TripLimits(math.inf, math.inf, math.inf, math.inf, (-5.0, 5.0), (0.0, 0.38), COUNT)
BANDWIDTH = 150.0  # Hz
HELD = Hands(HAND[1] / HAND_RANGE, STIFFEST_HAND)
POSITION, LEAN = 0.2, 0.5  # rad


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--rates", type=float, nargs="+", default=[800.0, 4000.0])
    parser.add_argument("--hands", type=int, default=24)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--measure", type=float, nargs="+", default=[])
    parser.add_argument("--fresh", type=int)
    options = parser.parse_args()
    if options.fresh is not None:
        names = ("static, motor", "inverse, motor")
        fresh_rows = [
            {"rate": rate, "variant": name, **fresh(rate, VARIANTS[name], options.fresh)}
            for rate in options.rates
            for name in names
        ]
        report({"fresh": fresh_rows}, options.json, show_fresh)
        return
    rows = [
        {
            "rate": rate,
            "variant": name,
            **measure(rate, dict(settings), options.hands, rate in options.measure),
        }
        for rate in options.rates
        for name, settings in VARIANTS.items()
    ]
    if options.plot is not None:
        draw(rows, options.plot)
    report({"walls": rows}, options.json, show)


def measure(rate: float, settings: dict[str, Any], hands: int, run: bool = False) -> dict[str, Any]:
    """Stiffest walls of one variant, guaranteed, simulated and measured, by rendered damping."""
    contact = settings.pop("contact", 0.0)
    stable = measured(rate, settings, contact) if run else []
    tuned = controller(rate, settings)
    simulated = [stiffest(tuned, damping, contact, hands) for damping in DAMPINGS]
    return {
        **(NOTHING if contact else guaranteed(tuned)),  # a switched brake is not passive
        "simulated": max(simulated),
        "measured": max(stable) if run else None,
        "simulated_by_damping": simulated,
        "measured_by_damping": stable,
    }


def guaranteed(tuned: TunedController) -> dict[str, float]:
    """What is promised of a controller's walls, zeros where nothing is."""
    tracker = Tracker(*tracker_gains(BANDWIDTH, 1.0 / tuned.control.sample_rate))
    actuators = np.concatenate([tuned.parameters[None], tuned.plausible(40)])
    try:
        promise = Passivity(tuned, tracker, actuators).promise(COUNT)
        held = Passivity(tuned, tracker, actuators, HELD).springs_promised()
    except UnknownPassivityError:
        return NOTHING
    return {
        "guaranteed": promise.stiffness,
        "guaranteed_damping": promise.damping,
        "held": held,
        "colgate": promise.colgate,
        "abbott": promise.abbott,
    }


def fresh(rate: float, settings: dict[str, Any], plants: int) -> dict[str, Any]:
    """What is promised in hands that damp, in parts of what is true on plants drawn anew."""
    tuned = controller(rate, settings)
    promised = guaranteed(tuned)["held"]
    drawn = tuned.plausible(plants, seed=1)
    true = [linear_limit(tuned, plant) for plant in drawn]
    program = tuned.control.program(tuned.model, tuned.parameters)
    scenes = [
        scene(tuned, promised, 0.0, 0.0, rise=rise, lean=lean, tap=tap)
        for rise in (0.02, 0.3)
        for lean in (0.05, 0.5, 1.5)
        for tap in (0.06, 0.6)
    ]
    outcomes = run_trials(tuned, program, scenes, LIMITS, 1000, seed=1)
    return {
        "held": promised,
        "part": float(np.median(promised / np.array(true))),
        "above": sum(promised > stiffness for stiffness in true),
        "plants": plants,
        "restless": int(outcomes.restless.sum()),
        "trials": len(outcomes.results),
    }


def linear_limit(tuned: TunedController, plant: FloatArray) -> float:
    """The stiffest wall whose loop is stable with all springs at a lightly damped handle."""
    control, dynamics = tuned.control, ActuatorDynamics(tuned.model, plant)
    law = LinearLaw.of(control.program(tuned.model, tuned.parameters), tuned.model)

    def stable(K: float) -> bool:
        G, D = law.G.copy(), law.D.copy()
        G[:, 0] -= K * law.G[:, 4]
        D[:, 0] -= K * law.D[:, 4]
        wall = replace(law, G=G, D=D)
        return all(
            loop_margins(
                wall, dynamics, "sliding forwards", (spring, HELD.damping),
                1.0 / control.sample_rate, control.ahead,
            ).stable
            for spring in np.geomspace(0.04, HELD.stiffness, 25).tolist()
        )  # fmt: skip

    low, high = 0.0, STIFFEST
    while high - low > 0.02 * high:
        middle = math.sqrt(max(low, 0.02) * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def controller(rate: float, settings: dict[str, Any]) -> TunedController:
    """A controller for the rig's own parameters, known to 3 %."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "settings.yaml"
        file.write_text(yaml.safe_dump({"sample_rate": rate, **settings}))
        path = folder / "controller.yaml"
        tune(file, model=MODEL).save(path)
        content = yaml.safe_load(path.read_text())
        factor = np.diag([SPREAD * content["parameters"][name] for name in UNCERTAIN])
        content["covariance"] = {"parameters": list(UNCERTAIN), "factor": factor.tolist()}
        path.write_text(yaml.safe_dump(content))
        return load_controller(str(path), folder)


def measured(rate: float, settings: dict[str, Any], contact: float) -> list[float]:
    """The stiffest wall that runs find stable in all hands [N*m/rad], by damping."""
    by_hand = [
        [_run_of_walls(rate, settings, contact, damping, scale) for damping in MEASURED]
        for scale in (1.0 / HAND_RANGE, 1.0, HAND_RANGE)
    ]
    return [min(column) for column in zip(*by_hand, strict=True)]


def _run_of_walls(
    rate: float, settings: dict[str, Any], contact: float, damping: float, scale: float
) -> float:
    """The stiffest wall of a run of them in one hand, or before a limit [N*m/rad]."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file, path = folder / "settings.yaml", folder / "controller.yaml"
        file.write_text(yaml.safe_dump({"sample_rate": rate, **settings}))
        tune(file, model=MODEL).save(path)
        content = yaml.safe_load(
            (Path(protocols.__file__).parent / "virtual_wall.yaml").read_text()
        )
        content |= {"sample_rate": rate, "torque_controller": str(path), "dampings": [damping]}
        content |= {"stiffnesses": list(GRID), "brake_commands": [contact]}
        content["rest"] = {**content["rest"], "stiffness": 0.1, "damping": damping}
        experiment = folder / "walls.yaml"
        experiment.write_text(yaml.safe_dump(content))
        grip = {"K_u": scale * HAND[0], "B_u": scale * HAND[1]}
        options = {"plant": {"load": "hand", "parameters": grip}}
        best = 0.0
        for stiffness in (None, *GRID):
            if stiffness is not None:
                experiment.write_text(yaml.safe_dump({**content, "stiffnesses": [stiffness]}))
            try:
                run = record(experiment, "hand.yaml", folder / "runs", options=options)
            except RunError:
                if stiffness is None:
                    continue  # a limit: one wall at a time tells which
                return best
            numbers = {n.name: n.value for n in analyse(run.path.parent).findings.numbers}
            if stiffness is None:
                return float(numbers["stiffest"])
            if numbers["stiffest"] < stiffness:
                return best
            best = stiffness
        return best


def stiffest(tuned: TunedController, damping: float, contact: float, hands: int) -> float:
    """The stiffest wall below the softest that did not rest [N*m/rad]."""
    low, high = 0.0, math.inf
    stiffness = 0.05
    while stiffness < STIFFEST and high == math.inf:
        if rests(tuned, stiffness, damping, contact, hands):
            low, stiffness = stiffness, 2.0 * stiffness
        else:
            high = stiffness
    while high < math.inf and high > 1.1 * max(low, 0.02):
        middle = math.sqrt(max(low, 0.02) * high)
        if rests(tuned, middle, damping, contact, hands):
            low = middle
        else:
            high = middle
    return low


def rests(
    tuned: TunedController, stiffness: float, damping: float, contact: float, hands: int
) -> bool:
    """Whether a wall comes to rest in all hands."""
    program = tuned.control.program(tuned.model, tuned.parameters)
    outcomes = run_trials(
        tuned, program, [scene(tuned, stiffness, damping, contact)], LIMITS, hands
    )
    return not (outcomes.restless | outcomes.left).any()


def scene(
    tuned: TunedController, stiffness: float, damping: float, contact: float, *,
    rise: float = 0.3, lean: float = LEAN, tap: float = 0.06,
) -> Scene:  # fmt: skip
    """A hand that comes within ``rise`` s, leans against a wall, and a tap of 5 ms."""
    time = 1.0 / tuned.control.sample_rate
    tapped, n = round(0.5 / time), round(1.4 / time)
    path = np.clip(np.arange(n + 1) * time / rise, 0.0, 1.0) * (POSITION + lean)
    alpha, beta = tracker_gains(BANDWIDTH, time)
    wall = np.zeros(trial.WALL)
    wall[: trial.TAP] = stiffness, damping, POSITION, contact, alpha, beta / time
    wall[trial.TAP : trial.SOFT] = tap, tapped, tapped + round(5e-3 / time)
    # No softer wall before: it would ring by itself where the delay is long.
    wall[trial.SOFT :] = min(stiffness, 0.1), damping, 8.0
    return Scene(np.zeros(n), np.ones(n), path, wall)


_DRAWN = {
    "guaranteed": ("guaranteed for any hand", "#0072B2"),
    "held": ("guaranteed for hands that damp", "#009E73"),
    "simulated": ("at rest in simulation", "#E69F00"),
    "measured": ("stable in runs of virtual_wall", "#CC79A7"),
}
_BAR = 0.2  # of the distance of two variants


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """The Z-width at each rate by what tells it, of the motor alone and with the brake."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rates = sorted({row["rate"] for row in rows})
    figure, axes = plt.subplots(1, len(rates), figsize=(5.6 * len(rates), 4.4),
                                squeeze=False, layout="constrained")  # fmt: skip
    names = list(VARIANTS)
    for rate, axis in zip(rates, axes[0], strict=True):
        chosen = {row["variant"]: row for row in rows if row["rate"] == rate}
        place = np.arange(len(names))
        lowest = 0.3 * min(row[key] for row in rows for key in _DRAWN if row[key])
        for j, (key, (label, color)) in enumerate(_DRAWN.items()):
            shift = _BAR * (j - 0.5 * (len(_DRAWN) - 1))
            stiffest = [chosen[name][key] for name in names]
            heights = [value or 0.0 for value in stiffest]
            bars = axis.bar(place + shift, heights, _BAR, label=label, color=color)
            labels = [f"{float(f'{value:.2g}'):g}" if value else "" for value in stiffest]
            axis.bar_label(bars, labels, fontsize=7)
            for k, value in enumerate(stiffest):
                if value == 0.0:  # None was not measured
                    axis.text(k + shift, 1.1 * lowest, "–", ha="center", fontsize=7)
        axis.set_ylim(lowest, 3.0 * max(row["simulated"] for row in rows))
        first = chosen[names[0]]
        bound = "2b/T, which leaves the delay out"
        axis.axhline(first["colgate"], color="0.4", lw=0.8, ls="--", label=bound)
        axis.set_yscale("log")
        axis.set_xticks(place, [name.replace(", ", ",\n") for name in names], fontsize=8)
        axis.set_title(f"{rate:g} Hz", fontsize=10, loc="left")
        axis.set_ylabel("stiffest wall [N·m/rad]", fontsize=9)
        axis.tick_params(labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper left", ncols=3,
                  fontsize=9, frameon=False)  # fmt: skip
    figure.savefig(path, dpi=150)


def show(figures: dict[str, Any]) -> None:
    print("stiffest walls [N*m/rad]")
    heads = ("guaranteed", "held", "simulated", "measured", "Colgate")
    print(f"{'rate':>6} {'variant':<30} " + " ".join(f"{h:>10}" for h in heads) + " Abbott")
    for row in figures["walls"]:
        print(
            f"{row['rate']:>6g} {row['variant']:<30} {row['guaranteed']:>10.3g} "
            f"{row['held']:>10.3g} {row['simulated']:>10.3g} {_cell(row['measured']):>10} "
            f"{row['colgate']:>10.3g} {row['abbott']:.3g}"
        )


def show_fresh(figures: dict[str, Any]) -> None:
    print("stiffest walls without damping in hands that damp [N*m/rad]")
    for row in figures["fresh"]:
        print(
            f"{row['rate']:>6g} {row['variant']:<20} promised {row['held']:.3g}, of the true one "
            f"{row['part']:.2f} in the median, above it on {row['above']} of {row['plants']} "
            f"plants; {row['restless']} of {row['trials']} trials do not come to rest"
        )


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


if __name__ == "__main__":
    main()
