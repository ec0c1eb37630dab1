"""How far identified parameters can be trusted: intervals, correlation, what stays open."""

from sysid.uncertainty.analysis import Ambiguity, Uncertainty, uncertainty
from sysid.uncertainty.estimate import Estimate
from sysid.uncertainty.profile import Profile, profile

__all__ = ["Ambiguity", "Estimate", "Profile", "Uncertainty", "profile", "uncertainty"]
