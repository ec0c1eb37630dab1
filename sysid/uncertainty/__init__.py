"""How far identified parameters can be trusted: intervals, correlation, what stays open."""

from sysid.uncertainty.analysis import Ambiguity, Uncertainty, uncertainty
from sysid.uncertainty.estimate import Estimate

__all__ = ["Ambiguity", "Estimate", "Uncertainty", "uncertainty"]
