"""Grey-box system identification: models as plain functions, populations at vector speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sysid.campaigns.campaign import Campaign, Outcome, Run, Spread, campaign, combinations
from sysid.engine.simulation import BatchResult, BatchSimulator, Status
from sysid.engine.stepper import Stepper
from sysid.fitting.free_run import free_run
from sysid.judging.comparison import Candidate, Comparison, compare
from sysid.problem.data import Dataset, output_scale
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
    from sysid.linear import ARMAX, ARX, select_orders

__all__ = [
    "ARMAX",
    "ARX",
    "GASSI",
    "BatchResult",
    "BatchSimulator",
    "Campaign",
    "Candidate",
    "Comparison",
    "Constraint",
    "Dataset",
    "Guess",
    "Input",
    "LinearModel",
    "Metrics",
    "ModelError",
    "Outcome",
    "Output",
    "Parameter",
    "ProcessModel",
    "Run",
    "SearchSpace",
    "Spread",
    "State",
    "Status",
    "Stepper",
    "campaign",
    "combinations",
    "compare",
    "equilibrium",
    "evaluate",
    "fit_percent",
    "free_run",
    "guess_ranges",
    "jacobian",
    "linearize",
    "msd",
    "output_scale",
    "regression",
    "rmse",
    "select_orders",
]


def __getattr__(name: str) -> Any:
    # scikit-learn takes most of a second to import; only the estimators need it.
    if name == "GASSI":
        from sysid.gassi import GASSI

        return GASSI
    if name in ("ARMAX", "ARX", "select_orders"):
        from sysid import linear

        return getattr(linear, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
