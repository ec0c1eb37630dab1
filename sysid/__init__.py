"""Grey-box system identification: models as plain functions, populations at vector speed."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

# A folder has its name: it must stand here before anyone asks for it.
from sysid.identifiability.analysis import identifiability

if TYPE_CHECKING:
    from sysid.campaigns.runs import Campaign, Outcome, Run, Spread, campaign, combinations
    from sysid.campaigns.study import Study, StudyResult, study
    from sysid.engine.simulation import BatchResult, BatchSimulator, Status
    from sysid.engine.stepper import Stepper
    from sysid.experiments import (
        Contest,
        Design,
        Discrimination,
        Excitation,
        Feedback,
        Prior,
        Setting,
        design,
        discriminate,
    )
    from sysid.fitting.free_run import free_run
    from sysid.gassi import GASSI
    from sysid.identifiability.combination import Combination
    from sysid.identifiability.findings import Identifiability, TiedGroup
    from sysid.judging.comparison import Candidate, Comparison, compare
    from sysid.linear import ARMAX, ARX, OE, select_orders
    from sysid.problem.data import Dataset, output_scale
    from sysid.problem.earlier_minima import EarlierMinima
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
    "Contest",
    "Dataset",
    "Design",
    "Discrimination",
    "EarlierMinima",
    "Excitation",
    "Feedback",
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
    "Study",
    "StudyResult",
    "TiedGroup",
    "campaign",
    "combinations",
    "compare",
    "design",
    "discriminate",
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
    "study",
]


# What a command does not use it does not import: scikit-learn alone takes most of a second.
_NAMES = {
    "sysid.campaigns.runs": "Campaign Outcome Run Spread campaign combinations",
    "sysid.campaigns.study": "Study StudyResult study",
    "sysid.engine.simulation": "BatchResult BatchSimulator Status",
    "sysid.engine.stepper": "Stepper",
    "sysid.experiments": (
        "Contest Design Discrimination Excitation Feedback Prior Setting design discriminate"
    ),
    "sysid.fitting.free_run": "free_run",
    "sysid.gassi": "GASSI",
    "sysid.identifiability.findings": "Identifiability TiedGroup",
    "sysid.identifiability.combination": "Combination",
    "sysid.judging.comparison": "Candidate Comparison compare",
    "sysid.linear": "ARMAX ARX OE select_orders",
    "sysid.problem.data": "Dataset output_scale",
    "sysid.problem.earlier_minima": "EarlierMinima",
    "sysid.problem.given": "Given",
    "sysid.problem.guesses": "Guess guess_ranges regression",
    "sysid.problem.metrics": "Metrics evaluate fit_percent msd rmse",
    "sysid.problem.model": "Constraint Input ModelError Output Parameter ProcessModel State",
    "sysid.problem.space": "SearchSpace",
    "sysid.response.linearization": "LinearModel equilibrium jacobian linearize",
}
_LAZY = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)
