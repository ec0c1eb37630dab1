"""Output-error fit of one output, y = (B(q) u + offset) / F(q) + e: the best linear free run.

The simulated output w is linear in B, the offset and the start of each record, which least squares
eliminate (variable projection, as in ``prediction_error``). With

    F(q) dw/df_l = -q^-l w,    F(q) dw/db_jl = q^-l u_j

scipy's ``least_squares`` searches the few coefficients of F, its roots kept inside the unit
circle. It starts from equation-error fits to signals filtered by 1/F of the fit before (Steiglitz
& McBride, IEEE Transactions on Automatic Control 10 (1965) 461-464), the best of some. Ljung,
System Identification, sections 4.2 and 10.2.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid.arrays import BoolArray, FloatArray, IntArray
from sysid.linear.polynomials import all_pole, reflect_poles
from sysid.linear.prediction_error import least_squares
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError

_REWEIGHTINGS = 10


class Drive:
    """What drives one output over all records, each from its row ``lag`` on.

    free: (m + 1, n_lags), which lags of the inputs and of 1 have a coefficient. columns: (n, p),
    those, and for each record the ``nf`` values that its rows before ``lag`` leave behind;
    n_coefficients: how many of them are no such values. y: (n,), NaN where lost.
    """

    def __init__(
        self, records: Sequence[Dataset], output: int, free: BoolArray, nf: int, lag: int
    ) -> None:
        self.n_coefficients = int(free.sum())
        tables, outputs, ages = [], [], []
        for k, record in enumerate(records):
            n, first = record.n_samples, min(lag, record.n_samples)
            signals = np.column_stack((record.inputs, np.ones(n)))
            table = np.zeros((n - first, self.n_coefficients + nf * len(records)))
            for column, (signal, age) in enumerate(np.argwhere(free)):
                table[:, column] = signals[first - age : n - age, signal]
            start = self.n_coefficients + nf * k
            table[:nf, start : start + nf] = np.eye(nf)[: n - first]
            tables.append(table)
            outputs.append(record.outputs[first:, output])
            ages.append(np.append(np.arange(n) >= first, False))
        self.columns, self.y = np.concatenate(tables), np.concatenate(outputs)
        self.seen = np.isfinite(self.y)
        self.position: IntArray = np.flatnonzero(np.concatenate(ages))[self.seen]
        lengths = np.array([len(table) for table in tables])
        self._begins = np.cumsum(lengths)[:-1]
        unknowns = nf + self.columns.shape[1]
        if self.seen.sum() <= unknowns:
            raise ModelError(
                f"output {output} has {self.seen.sum()} measured rows with a complete past for "
                f"{unknowns} coefficients and starts: lower nf or nb, or give longer records"
            )

    def through(self, f: FloatArray, columns: FloatArray) -> FloatArray:
        """Columns (n, k) filtered by 1/F(q), from zero at the start of each record."""
        return all_pole(f, columns, self._begins.tolist())

    def past(self, values: FloatArray, lags: int) -> FloatArray:
        """Values (n,) of 1, 2, ... rows earlier, zero before each record, (n, lags)."""
        parts = [np.append(np.zeros(lags), part) for part in np.split(values, self._begins)]
        windows = [sliding_window_view(part[:-1], lags) for part in parts]
        return np.concatenate(windows)[:, ::-1]


class OutputErrorFit:
    """The best B, offset and starts at a given F(q); the attributes are those of ``EquationFit``.

    f: (nf,), F's coefficients after the leading 1. simulated: (n,), lost rows included.
    """

    log_det = 0.0
    iterations = 0
    converged = True
    c = np.zeros(0)

    def __init__(self, drive: Drive, f: FloatArray) -> None:
        self._drive, self.f, self.position = drive, f, drive.position
        response = drive.through(f, drive.columns)
        table = np.column_stack((response, drive.y))[drive.seen]
        solution, residual, self._basis = least_squares(table, response.shape[1])
        self.simulated = response @ solution[:, 0]
        self.residual = self.errors = residual[:, 0]
        self.theta = np.concatenate((f, solution[: drive.n_coefficients, 0]))
        self._response = response[drive.seen]
        self.squares = float(self.residual @ self.residual)

    @cached_property
    def slopes(self) -> FloatArray:
        """Minus the derivatives of the simulated output by F's coefficients, (n, nf)."""
        past = self._drive.past(self.simulated, len(self.f))
        return self._drive.through(self.f, past)[self._drive.seen]

    @property
    def projected_slopes(self) -> FloatArray:
        """The same as B, the offset and the starts follow (Kaufman)."""
        slopes: FloatArray = self.slopes - self._basis @ (self._basis.T @ self.slopes)
        return slopes

    @property
    def sensitivity(self) -> FloatArray:
        """Derivatives of the simulated output by theta, but for what the starts take up."""
        n = self._drive.n_coefficients
        coefficients = np.column_stack((-self.slopes, self._response[:, :n]))
        starts = np.linalg.qr(self._response[:, n:])[0]
        return np.asarray(coefficients - starts @ (starts.T @ coefficients), dtype=np.float64)

    def reweighted(self) -> FloatArray:
        """F of the equation-error fit to signals filtered by 1/F of this one."""
        drive, nf = self._drive, len(self.f)
        y = np.where(drive.seen, drive.y, self.simulated)
        past = drive.past(y, nf)
        filtered = drive.through(self.f, np.column_stack((-past, drive.columns, y)))
        return stable(least_squares(filtered, filtered.shape[1] - 1)[0][:nf, 0])


def fit_output_error(drive: Drive, nf: int, limit: int) -> OutputErrorFit:
    """Minimise the squared error of the free run, in so many evaluations at most."""
    fit = OutputErrorFit(drive, np.zeros(nf))
    if nf == 0:
        return fit
    import scipy.optimize  # slow, and not needed to predict

    starts = [fit]
    for _ in range(_REWEIGHTINGS):
        starts.append(OutputErrorFit(drive, starts[-1].reweighted()))
    start = min(starts, key=lambda fit: fit.squares)
    latest = start

    def at(f: FloatArray) -> OutputErrorFit:
        nonlocal latest
        if not np.array_equal(f, latest.f):
            latest = OutputErrorFit(drive, stable(f))
        return latest

    def residual(f: FloatArray) -> FloatArray:
        return at(f).residual

    def slopes(f: FloatArray) -> FloatArray:
        return at(f).projected_slopes

    search = scipy.optimize.least_squares(residual, start.f, slopes, x_scale="jac", max_nfev=limit)
    fit = OutputErrorFit(drive, stable(search.x))
    fit.iterations, fit.converged = search.nfev, bool(search.status > 0)
    return fit


def stable(f: FloatArray) -> FloatArray:
    """F's coefficients with roots outside the unit circle mirrored at it."""
    if not np.all(np.isfinite(f)):
        return np.zeros_like(f)
    return reflect_poles(np.append(1.0, f)[:, None, None])[1:, 0, 0]
