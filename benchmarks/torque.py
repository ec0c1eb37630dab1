"""How well torque controllers give a torque to a moving hand, beside the static baseline.

python -m benchmarks.torque [--json] [--rigs 3] [--seconds 10] [--identify] [--worn] [--free]
                            [--controllers static feedforward lqg hinf]

Rigs are drawn: each of the actuator's parameters 0.8 to 1.25 times the simulated rig's, the hand's
stiffness and damping 0.25 to 4 times theirs, the hand's motion at random, at up to 10 rad/s. The
reference is a multisine of 0.2 N*m from 0.1 to 10 Hz. Errors are those of the torque that the hand
truly felt, at all frequencies: the plant is simulated again with the voltages of the log. A sensor
that a controller listens to is no judge of it. ``--identify``: parameters as ``prbs.yaml`` and
``rig identify`` find them, otherwise the true ones. ``--worn``: unevenly worn brushes, of which the
controllers' model, with Stribeck friction, knows the mean. ``--free``: the torque felt in free
motion instead, by the shaft's speed and up to 5 Hz, in parts of what is felt without commands.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.signal import butter, sosfiltfilt

import haptics
import protocols
from benchmarks._common import arguments, report
from daq import Recording, identify, record, tune
from daq.hal import FloatArray
from daq.logs.recording import load
from sim_rig.actuator import actuator
from sim_rig.device.user import SimulatedUser
from sim_rig.physics.loads import HAND_DAMPING, HAND_STIFFNESS
from sim_rig.plant import Plant, state_sizes
from sysid import Stepper

DRAWN = (
    *("R_m", "L_m", "K_m", "R_b", "L_b", "J_m", "B_m", "J_b"),
    *("gamma", "A", "alpha0", "alpha1", "c0", "c1"),
)
SPREAD = 1.25  # factor either way
HAND = 4.0  # likewise
WEIGHT = 0.12  # kg
WINDER = 8.0  # hands that hold the wound load
RATE = 800.0  # Hz
FREE_BAND = 5.0  # Hz
SETTLED = 0.4  # s of a block, that do not count
COUNTS = 3e-3  # rad, four counts of the encoder


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--rigs", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--identify", action="store_true")
    parser.add_argument("--worn", action="store_true")
    parser.add_argument("--free", action="store_true")
    controllers = ["static", "feedforward", "lqg", "hinf"]
    parser.add_argument("--controllers", nargs="+", default=controllers)
    options = parser.parse_args()
    rows = [measure(options.seed + k, options) for k in range(options.rigs)]
    report({"rigs": rows}, options.json, show_free if options.free else show)


def measure(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """What the controllers leave on one drawn rig."""
    worn = options.worn
    rng = np.random.default_rng(seed)
    plant = drawn_plant(rng, worn)
    hand = drawn_motion(rng)
    rig = {"seed": seed, "plant": {**plant, "load": "hand"}, "hand": hand, "hand_path": "smooth"}
    errors = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = _identified(folder, seed, plant) if options.identify else _true(folder, plant)
        protocol = "transparency" if options.free else "torque_tracking"
        changes = {} if options.free else {"duration": options.seconds, "seed": seed}
        for controller in options.controllers:
            settings = folder / f"{controller}_settings.yaml"
            content = {**shipped(haptics, "torque.yaml"), "controller": controller}
            settings.write_text(yaml.safe_dump(content))
            tune(settings, model).save(folder / f"{controller}.yaml")
            experiment = folder / f"{protocol}.yaml"
            content = shipped(protocols, f"{protocol}.yaml")
            content |= {"torque_controller": str(folder / f"{controller}.yaml"), **changes}
            experiment.write_text(yaml.safe_dump(content))
            run = record(experiment, "moving_hand.yaml", folder / "runs", options=rig)
            left = free if options.free else felt
            errors[controller] = left(run.path, rig)
    return {"seed": seed, "hand": plant["parameters"]["K_u"], "errors": errors}


def drawn_plant(rng: np.random.Generator, worn: bool) -> dict[str, Any]:
    """Options of a plant with parameters of its own."""
    plant = Plant(load="hand").build()
    values = dict(zip(plant.parameter_names, plant.nominal.tolist(), strict=True))
    factors = SPREAD ** rng.uniform(-1.0, 1.0, len(DRAWN))
    parameters = {k: values[k] * f for k, f in zip(DRAWN, factors.tolist(), strict=True)}
    grip = float(HAND ** rng.uniform(-1.0, 1.0))
    parameters |= {"K_u": values["K_u"] * grip, "B_u": values["B_u"] * grip}
    return {"parameters": parameters, **({"friction": "cyclic"} if worn else {})}


def drawn_motion(rng: np.random.Generator) -> list[list[float]]:
    """Times and angles of a wrist that turns at up to about 10 rad/s."""
    times = np.cumsum(rng.uniform(0.25, 0.8, 40))
    steps = rng.choice([-1.0, 1.0], len(times)) * rng.uniform(0.3, 1.0, len(times))
    angles = np.cumsum(steps * np.minimum(np.diff(times, prepend=0.0) * 6.0, 3.0))
    return [[float(t), float(a)] for t, a in zip(times, angles, strict=True)]


def felt(log: Path, rig: Mapping[str, Any]) -> dict[str, float]:
    """Error of the true torque on the hand [N*m], rms, and the largest speed [rad/s] of a run."""
    run = load(log, ("torque_ref",))
    torque, speed = replayed(run, rig)
    error = torque - run.frame["torque_ref"].to_numpy()
    return {
        "error_rms": float(np.sqrt(np.mean(error**2))),
        "speed": float(np.abs(speed).max()),
    }


def free(log: Path, rig: Mapping[str, Any]) -> dict[str, float]:
    """The torque felt in free motion by the speed, in parts of that without commands."""
    run = load(log, ("controlled",))
    torque, speed = replayed(run, rig)
    low = sosfiltfilt(butter(2, FREE_BAND, fs=RATE, output="sos"), torque)
    controlled = run.frame["controlled"].to_numpy()
    within = np.arange(len(controlled)) / RATE % shipped(protocols, "transparency.yaml")["block"]
    ratios = []
    for share in (1.0, 0.0):
        rows = (controlled == share) & (within > SETTLED)
        ratios.append(float(np.std(low[rows]) / np.std(speed[rows])))
    return {"left": ratios[0] / ratios[1], "speed": float(np.abs(speed).max())}


def replayed(run: Recording, rig: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """True torque on the hand [N*m] and speed [rad/s]: the plant with a run's voltages."""
    plant = Plant.model_validate(rig["plant"]).build()
    names = [output.name for output in plant.outputs]
    log = run.frame
    hand = SimulatedUser(True, rig["hand"], smooth=True)
    hand.move(0.0)
    motion = hand.motion(np.arange(len(log) + 1) / RATE)
    applied = log[["applied_voltage_motor", "applied_voltage_brake"]].to_numpy()
    inputs = np.hstack([np.vstack([applied, applied[-1:]]), motion])
    stepper = Stepper(plant, plant.nominal, 1.0 / RATE, scale=state_sizes(plant))
    _, true = stepper.advance(plant.initial_state, inputs)
    apart = log["theta"] - true[:, names.index("theta")]
    if np.abs(apart).max() > COUNTS:
        raise RuntimeError(f"the second simulation is {np.abs(apart).max():.2g} rad off the run")
    return -true[:, names.index("torque")], true[:, names.index("omega")]


def shipped(package: Any, name: str) -> dict[str, Any]:
    """The content of a shipped file."""
    path = Path(package.__file__).parent / name
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return content


def _identified(folder: Path, seed: int, plant: Mapping[str, Any]) -> Path:
    """What the shipped experiment tells of such a rig, as parameters.yaml."""
    # Whoever winds the load holds on as firmly as its friction asks for, and hangs what it holds.
    grip = {"K_u": WINDER * HAND_STIFFNESS, "B_u": WINDER * HAND_DAMPING}
    pulley = {**plant["parameters"], **grip, "mass": WEIGHT}
    options = {"seed": seed, "plant": {**plant, "parameters": pulley}}
    run = record("prbs.yaml", "simulated.yaml", folder / "runs", options=options)
    name = "actuator:friction=stribeck" if "friction" in plant else "actuator"
    return identify(run, model=name, seed=seed).save(folder)


def _true(folder: Path, plant: Mapping[str, Any]) -> Path:
    """The rig's own parameters, as if identified without error."""
    friction = "stribeck" if "friction" in plant else "none"
    model = actuator(friction=friction, parameters="rig")  # type: ignore[arg-type]
    values = dict(zip(model.parameter_names, model.nominal.tolist(), strict=True))
    values |= {k: v for k, v in plant["parameters"].items() if k in values}
    path = folder / "parameters.yaml"
    covariance: dict[str, list[Any]] = {"parameters": [], "factor": []}
    name = f"actuator:friction={friction}"
    content = {"model": name, "parameters": values, "covariance": covariance}
    path.write_text(yaml.safe_dump(content))
    return path


def show(figures: dict[str, Any]) -> None:
    rows = figures["rigs"]
    names = list(rows[0]["errors"])
    print("error of the torque felt, rms [mN*m], and in parts of the first controller's")
    print(f"{'rig':>4} {'hand':>8} {'speed':>6} " + " ".join(f"{name:>18}" for name in names))
    for row in rows:
        errors = [row["errors"][name]["error_rms"] for name in names]
        cells = [f"{1e3 * error:8.2f} {error / errors[0]:9.3f}" for error in errors]
        speed = row["errors"][names[0]]["speed"]
        print(
            f"{row['seed']:>4} {row['hand']:8.3f} {speed:6.1f} "
            + " ".join(f"{c:>18}" for c in cells)
        )


def show_free(figures: dict[str, Any]) -> None:
    print("torque felt in free motion up to 5 Hz, in parts of that without commands")
    for row in figures["rigs"]:
        parts = "  ".join(f"{name} {each['left']:.3f}" for name, each in row["errors"].items())
        print(f"{row['seed']:>4} {row['hand']:8.3f}  {parts}")


if __name__ == "__main__":
    main()
