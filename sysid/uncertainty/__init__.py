"""How far identified parameters can be trusted: intervals, correlation, what stays open."""

from sysid.uncertainty.analysis import Ambiguity, Uncertainty, determined_rank, uncertainty
from sysid.uncertainty.estimate import Estimate
from sysid.uncertainty.profile import Profile, profile

__all__ = [
    "Ambiguity",
    "Estimate",
    "Profile",
    "Uncertainty",
    "determined_rank",
    "profile",
    "uncertainty",
]
