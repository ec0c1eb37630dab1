"""Grey-box system identification: models as plain functions, populations at vector speed."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sysid.campaigns.runs import Campaign, Outcome, Run, Spread, campaign, combinations
from sysid.design import Design, Excitation, Prior, Setting, design
from sysid.engine.simulation import BatchResult, BatchSimulator, Status
from sysid.engine.stepper import Stepper
from sysid.fitting.free_run import free_run
from sysid.identifiability.analysis import Identifiability, TiedGroup, identifiability
from sysid.identifiability.combination import Combination
from sysid.judging.comparison import Candidate, Comparison, compare
from sysid.problem.data import Dataset, output_scale
from sysid.problem.given import Given
from sysid.problem.guesses import Guess, guess_ranges, regression
from sysid.problem.metrics import Metrics, evaluate, fit_percent, msd, rmse
from sysid.problem.model import (
    Constraint,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
)
from sysid.problem.space import SearchSpace
from sysid.response.linearization import LinearModel, equilibrium, jacobian, linearize

if TYPE_CHECKING:
    from sysid.gassi import GASSI
    from sysid.linear import ARMAX, ARX, OE, select_orders

__all__ = [
    "ARMAX",
    "ARX",
    "GASSI",
    "OE",
    "BatchResult",
    "BatchSimulator",
    "Campaign",
    "Candidate",
    "Combination",
    "Comparison",
    "Constraint",
    "Dataset",
    "Design",
    "Excitation",
    "Given",
    "Guess",
    "Identifiability",
    "Input",
    "LinearModel",
    "Metrics",
    "ModelError",
    "Outcome",
    "Output",
    "Parameter",
    "Prior",
    "ProcessModel",
    "Run",
    "SearchSpace",
    "Setting",
    "Spread",
    "State",
    "Status",
    "Stepper",
    "TiedGroup",
    "campaign",
    "combinations",
    "compare",
    "design",
    "equilibrium",
    "evaluate",
    "fit_percent",
    "free_run",
    "guess_ranges",
    "identifiability",
    "jacobian",
    "linearize",
    "msd",
    "output_scale",
    "regression",
    "rmse",
    "select_orders",
]


# scikit-learn takes most of a second to import; only the estimators need it.
_LAZY = {
    "ARMAX": "sysid.linear",
    "ARX": "sysid.linear",
    "GASSI": "sysid.gassi",
    "OE": "sysid.linear",
    "select_orders": "sysid.linear",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)
