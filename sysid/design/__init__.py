"""Experiments that tell most about a model's parameters, before they are run."""

from sysid.design.excitation import Excitation, Setting
from sysid.design.experiment import Design, DesignedRun, PredictedQuantity, design
from sysid.design.prior import Prior

__all__ = ["Design", "DesignedRun", "Excitation", "PredictedQuantity", "Prior", "Setting", "design"]
