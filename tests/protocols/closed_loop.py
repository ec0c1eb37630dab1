"""Runs of protocols on the simulated rig, in this process and in virtual time."""

from pathlib import Path

import yaml

import protocols
from daq.config.rig import RigConfig
from daq.logs.recording import load
from daq.run.runner import run_experiment
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.support import merged

SHIPPED = Path(protocols.__file__).parent


def shipped(name, kind, **changes):
    """The experiment of a shipped file, with changes."""
    return kind.model_validate(merged(yaml.safe_load((SHIPPED / name).read_text("utf-8")), changes))


def run(experiment, folder, plant, rig=None, **options):
    """Samples and the controller's columns of a run on such a plant."""
    device = SimulatedDevice(Simulation.model_validate({"plant": plant, **options}))
    config = RigConfig.model_validate(rig or {})
    result = run_experiment(experiment, "test", config, device, folder)
    return logged(experiment, result.folder)


def logged(experiment, folder):
    log = load(folder / "log.csv", tuple(experiment.columns))
    return log.samples(), {name: log.frame[name].to_numpy() for name in experiment.columns}


def numbers(found):
    return {number.name: number for number in found.numbers}
