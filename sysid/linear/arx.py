"""ARX models by least squares."""

from __future__ import annotations

from sysid.linear.base import PolynomialModel
from sysid.linear.orders import Order, Orders


class ARX(PolynomialModel):
    """Identify A(q) y = B(q) u + offset + e by linear least squares.

    y(t) + A_1 y(t-1) + ... = B_nk u(t-nk) + ... + offset + e(t), with full matrices. Ljung,
    System Identification, sections 4.2 and 10.1. Biased when the noise is not white; ``ARMAX``
    models its colour.

    Parameters
    ----------
    na : lags of the outputs: one number, or (n_outputs, n_outputs), a row for each equation.
    nb : coefficients of the inputs: one number, or (n_outputs, n_inputs).
    nk : samples before an input first acts, as nb. 1 where a row's outputs are latched before
        its inputs are applied (see ``Dataset``); 0 lets an input act on its own row.
    offset : estimate a constant for each equation. It carries the operating point: the model
        is linear about it, and no mean is subtracted.
    stable : mirror unstable poles in the unit circle and estimate B and offset again.

    Attributes
    ----------
    A_ : (n_lags + 1, n_outputs, n_outputs), by lag; A_[0] is the identity.
    B_ : (n_lags + 1, n_outputs, n_inputs), by lag; zero where nk delays.
    C_ : (nc + 1, n_outputs), the diagonal of C by lag; C_[0] is 1.
    offset_ : (n_outputs,), zero with offset=False.
    A_std_, B_std_, C_std_, offset_std_ : standard errors, of the same shapes; infinite where
        the data do not determine a coefficient, NaN where ``stable`` moved it.
    theta_, names_, covariance_ : all coefficients (n,), their names (``a2[0,1]`` weighs
        y_1(t-2) in the equation of y_0) and covariance (n, n).
    noise_covariance_ : (n_outputs, n_outputs) of e.
    residuals_ : per output (n_rows,), the estimate of e in each equation that was fitted.
    loss_ : (n_outputs,) mean square of e, that before each record included.
    log_likelihood_, aic_, bic_ : Gaussian, over the n_rows_ instants known for every output.
    n_lags_ : rows of a record that have no complete past.
    poles_, radius_, stable_ : roots of det A, the largest one's size, whether that is below 1.
    reflected_ : whether ``stable`` had to move poles.
    input_mean_, output_mean_ : operating point that simulations start from; zero with
        offset=False.
    dt_ : sample time [s], None if arrays came without.
    """

    def __init__(
        self,
        na: Order = 2,
        nb: Order = 2,
        nk: Order = 1,
        *,
        offset: bool = True,
        stable: bool = False,
    ) -> None:
        self.na = na
        self.nb = nb
        self.nk = nk
        self.offset = offset
        self.stable = stable

    def _orders(self, n_outputs: int, n_inputs: int) -> Orders:
        return Orders.of(
            n_outputs, n_inputs, na=self.na, nb=self.nb, nc=0, nk=self.nk, offset=self.offset
        )
