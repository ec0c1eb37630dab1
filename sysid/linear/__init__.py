"""Linear difference-equation models, the baseline that a physical model has to beat."""

from sysid.linear.estimator import ARMAX, ARX, OE
from sysid.linear.selection import OrderCandidate, Orders, Selection, select_orders, tuned

__all__ = ["ARMAX", "ARX", "OE", "OrderCandidate", "Orders", "Selection", "select_orders", "tuned"]
