"""Linear difference-equation models, the baseline that a physical model has to beat."""

from sysid.linear.armax import ARMAX
from sysid.linear.arx import ARX
from sysid.linear.selection import Candidate, Selection, select_orders, tuned

__all__ = ["ARMAX", "ARX", "Candidate", "Selection", "select_orders", "tuned"]
