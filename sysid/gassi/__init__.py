"""Genetic algorithm for stable system identification (GASSI) and its relatives."""

from sysid.gassi.estimator import GASSI, Progress
from sysid.gassi.genetic_search import PRESETS, GeneticSearch, Preset, PresetName

__all__ = ["GASSI", "PRESETS", "GeneticSearch", "Preset", "PresetName", "Progress"]
