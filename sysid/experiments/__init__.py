"""Experiments that tell most about a model's parameters, before they are run."""

from sysid.experiments.discrimination import Contest, Discrimination, discriminate
from sysid.experiments.excitation import Excitation, Setting
from sysid.experiments.experiment import (
    ChosenRuns,
    Design,
    DesignedRun,
    PredictedQuantity,
    design,
    is_as_narrow,
)
from sysid.experiments.feedback import Feedback
from sysid.experiments.prior import Prior

__all__ = [
    "ChosenRuns",
    "Contest",
    "Design",
    "DesignedRun",
    "Discrimination",
    "Excitation",
    "Feedback",
    "PredictedQuantity",
    "Prior",
    "Setting",
    "design",
    "discriminate",
    "is_as_narrow",
]
