"""Linear difference-equation models, the baseline that a physical model has to beat."""

from sysid.linear.estimator import ARMAX, ARX
from sysid.linear.selection import OrderCandidate, Selection, select_orders, tuned

__all__ = ["ARMAX", "ARX", "OrderCandidate", "Selection", "select_orders", "tuned"]
