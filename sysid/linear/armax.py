"""ARMAX models by prediction-error minimisation."""

from __future__ import annotations

from sysid.linear.base import PolynomialModel
from sysid.linear.orders import Order, Orders
from sysid.problem.model import ModelError


class ARMAX(PolynomialModel):
    """Identify A(q) y = B(q) u + offset + C(q) e by minimising one-step prediction errors.

    A and B are full, C is diagonal, so that each output's equation is a problem of its own: to
    maximise the Gaussian likelihood of its one-step prediction errors. Each C has its roots
    inside the unit circle. The noise before the first complete row of a record, and before the
    first one after a gap, is unknown and counts as such: taken for zero, as is common, it
    biases a C that forgets slowly. Ljung, System Identification, sections 4.2, 7.2 to 7.4
    and 10.2.

    Parameters
    ----------
    na, nb, nk, offset, stable : as of ``ARX``; with ``stable``, C is estimated again too.
    nc : lags of the noise: one number, or (n_outputs,).
    max_iterations : of the search for each output's C.

    Attributes
    ----------
    iterations_, converged_ : iterations for each output, and whether all were enough.
    Others : those of ``ARX``.
    """

    def __init__(
        self,
        na: Order = 2,
        nb: Order = 2,
        nc: Order = 2,
        nk: Order = 1,
        *,
        offset: bool = True,
        stable: bool = False,
        max_iterations: int = 50,
    ) -> None:
        self.na = na
        self.nb = nb
        self.nc = nc
        self.nk = nk
        self.offset = offset
        self.stable = stable
        self.max_iterations = max_iterations

    def _orders(self, n_outputs: int, n_inputs: int) -> Orders:
        return Orders.of(
            n_outputs,
            n_inputs,
            na=self.na,
            nb=self.nb,
            nc=self.nc,
            nk=self.nk,
            offset=self.offset,
        )

    def _iterations(self) -> int:
        if self.max_iterations < 1:
            raise ModelError(f"max_iterations is {self.max_iterations}; it must be 1 or more")
        return self.max_iterations
