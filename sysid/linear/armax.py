"""ARX and ARMAX models as scikit-learn regressors."""

from dataclasses import KW_ONLY, dataclass

from sysid.linear.estimator import PolynomialModel
from sysid.linear.polynomials import Order


@dataclass(repr=False, eq=False)
class ARX(PolynomialModel):
    """Identify A(q) y = B(q) u + offset + e by linear least squares.

    y(t) + A_1 y(t-1) + ... = B_nk u(t-nk) + ... + offset + e(t), with full matrices. Biased when
    the noise is not white; ``ARMAX`` models its colour. Ljung, System Identification, sections
    4.2 and 10.1.

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
    A_, B_ : (n_lags + 1, n_outputs, n_outputs) and (n_lags + 1, n_outputs, n_inputs), by lag.
    C_, offset_ : (nc + 1, n_outputs), the diagonal of C by lag, and (n_outputs,).
    A_std_, B_std_, C_std_, offset_std_ : standard errors; infinite where the data do not
        determine a coefficient, NaN where ``stable`` moved it.
    theta_, names_, covariance_ : all coefficients (n,), their names (``a2[0,1]`` weighs
        y_1(t-2) in the equation of y_0) and covariance (n, n).
    residuals_ : per output (n_rows,), the estimate of e in each equation that was fitted.
    loss_, noise_covariance_ : mean square of e (n_outputs,), that before each record included;
        its covariance (n_outputs, n_outputs).
    log_likelihood_, aic_, bic_ : Gaussian, over the n_rows_ instants known for every output.
    poles_, radius_, stable_ : roots of det A, the largest one's size, whether that is below 1.
    reflected_ : whether ``stable`` had to move poles.
    input_mean_, output_mean_ : operating point that simulations start from; zero with
        offset=False.
    n_lags_, dt_ : rows of a record that have no complete past; sample time [s] or None.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> u = np.tile([1.0, 1.0, -1.0], 20)
    >>> y = lfilter([0.0, 0.2], [1.0, -0.9], u)  # y(t) = 0.9 y(t-1) + 0.2 u(t-1)
    >>> model = ARX(na=1, nb=1, offset=False).fit(u[:, None], y)
    >>> dict(zip(model.names_, model.theta_.round(6).tolist()))
    {'a1[0,0]': -0.9, 'b1[0,0]': 0.2}
    """

    na: Order = 2
    nb: Order = 2
    nk: Order = 1
    _: KW_ONLY
    offset: bool = True
    stable: bool = False


@dataclass(repr=False, eq=False)
class ARMAX(PolynomialModel):
    """Identify A(q) y = B(q) u + offset + C(q) e by minimising one-step prediction errors.

    A and B are full, C is diagonal with its roots inside the unit circle. Each output's equation
    maximises the Gaussian likelihood of its own prediction errors, in which the noise before a
    record, or after a gap, is as unknown as any other (``sysid.linear.prediction_error``).

    Parameters
    ----------
    na, nb, nk, offset, stable : as of ``ARX``; with ``stable``, C is estimated again too.
    nc : lags of the noise: one number, or (n_outputs,).
    max_iterations : of the search for each output's C.

    Attributes
    ----------
    iterations_, converged_ : iterations for each output, and whether all were enough.
    Others : those of ``ARX``.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> u, e = np.random.default_rng(0).normal(size=(2, 500))
    >>> y = lfilter([0.0, 0.2], [1.0, -0.9], u) + 0.1 * e  # measurement noise: C equals A
    >>> model = ARMAX(na=1, nb=1, nc=1).fit(u[:, None], y)
    >>> model.A_[1, 0].round(1), model.C_[1].round(1)
    (array([-0.9]), array([-0.9]))
    """

    na: Order = 2
    nb: Order = 2
    nc: Order = 2
    nk: Order = 1
    _: KW_ONLY
    offset: bool = True
    stable: bool = False
    max_iterations: int = 50
