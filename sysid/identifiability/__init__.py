"""Structural identifiability: what a model's equations determine, without any data."""

from typing import TYPE_CHECKING, Any

from sysid.identifiability.analysis import identifiability
from sysid.identifiability.combination import Combination, Term
from sysid.identifiability.findings import Identifiability, TiedGroup

if TYPE_CHECKING:
    from sysid.identifiability.directions import null_directions

__all__ = [
    "Combination",
    "Identifiability",
    "Term",
    "TiedGroup",
    "identifiability",
    "null_directions",
]


def __getattr__(name: str) -> Any:
    if name != "null_directions":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sysid.identifiability.directions import null_directions  # loads flint

    return null_directions
