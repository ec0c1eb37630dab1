"""Structural identifiability: what a model's equations determine, without any data."""

from sysid.identifiability.analysis import Identifiability, TiedGroup, identifiability
from sysid.identifiability.combination import Combination, Term
from sysid.identifiability.directions import null_directions

__all__ = [
    "Combination",
    "Identifiability",
    "Term",
    "TiedGroup",
    "identifiability",
    "null_directions",
]
