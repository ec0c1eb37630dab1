"""Experiments of the shipped protocols from a few settings."""

import yaml

from daq.config.rig import RigConfig
from daq.lookup.experiments import load_experiment

SHORT = {"calibration": {"samples": 16}}


def loaded(folder, **settings):
    """An experiment read from a file, as the commands read it."""
    path = folder / "e.yaml"
    path.write_text(yaml.safe_dump(SHORT | settings, sort_keys=False))
    return load_experiment(str(path))


def planned(folder, **settings):
    """Commands of an experiment on the rig's default limits, (n, 2)."""
    return loaded(folder, **settings).plan(RigConfig()).commands
