"""ARX and ARMAX models as scikit-learn regressors: identification, free runs, predictions."""

import warnings
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, Self

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.linear.output_error import Drive, OutputErrorFit, fit_output_error
from sysid.linear.polynomials import (
    Layout,
    Order,
    filtered,
    innovations,
    order_table,
    poles,
    reflect_poles,
)
from sysid.linear.prediction_error import EquationFit, Stack, fit_equation, influence
from sysid.problem.data import Dataset
from sysid.problem.metrics import evaluate
from sysid.problem.model import ModelError
from sysid.problem.records import Data, RecordEstimator, given_datasets, split
from sysid.threads import one_thread

_UNSTABLE_GROWTH = 1e6  # of a response over its start, beyond which the model is unstable


Fit = EquationFit | OutputErrorFit


@dataclass(repr=False, eq=False)
class PolynomialModel(RecordEstimator):
    """A(q) y = B(q) u + offset + C(q) e, at rest at an operating point before each record."""

    fitted = "theta_"

    _: KW_ONLY
    offset: bool = True
    stable: bool = False

    # Whether no output acts on another, so that each may have orders of its own.
    separate: ClassVar[bool] = False

    def fit(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None, dt: float | None = None
    ) -> Self:
        """Estimate the coefficients from one record or several; warns if the model is unstable.

        X: one Dataset, several of any lengths, or an array (n_samples, n_inputs) with y
        (n_samples,) or (n_samples, n_outputs), NaN where a sample was lost; then records
        (n_samples,) tells which record a row belongs to, and dt [s] lets Datasets of another
        sample time be refused. Raises ModelError for orders or data that make no sense.
        """
        with one_thread():
            self._fit_rows(0, X, y, records, dt)
        if not self.stable_:
            warnings.warn(
                f"the {type(self).__name__} model is unstable (largest pole {self.radius_:.4g}): "
                "its free runs grow without bound; stable=True mirrors such poles, lower orders "
                "may avoid them",
                stacklevel=2,
            )
        return self

    def predict(self, X: Data, *, records: Any = None, dt: float | None = None) -> FloatArray:
        """Free-run outputs of the identified model, (n_samples, n_outputs).

        A Dataset starts with those ``n_lags_`` first rows with which the whole record fits best;
        each of the ``records`` of an array from rest. (n_samples,) if the outputs of ``fit`` were.
        """
        self._check_fitted()
        datasets = given_datasets(X)
        if datasets is not None:
            return self._fitted_run(self._checked(datasets))
        inputs = self._inputs(X, reset=False)
        runs = [self._free_run(inputs[rows]) for rows in split(len(inputs), records)]
        return self._shaped(np.concatenate(runs))

    def simulate(self, X: FloatArray, initial: FloatArray | None = None) -> FloatArray:
        """Free run from the inputs alone, without noise; (n_samples, n_outputs).

        initial: (k, n_outputs), outputs of the first k rows, returned as they are; ``n_lags_`` of
        them define the start. Before the first row inputs are at ``input_mean_`` and outputs at
        ``initial[0]``, by default ``output_mean_``.
        """
        self._check_fitted()
        inputs, q = self._inputs(X, reset=False), len(self.offset_)
        if initial is None:
            return self._shaped(self._free_run(inputs))
        first = np.asarray(initial, dtype=np.float64)
        if first.ndim < 2 and first.size % q == 0:
            first = first.reshape(-1, q)
        if first.shape[1:] != (q,) or not 1 <= len(first) <= len(inputs):
            raise ModelError(
                f"initial has shape {np.shape(initial)}; give the outputs of the first rows, one "
                f"to {len(inputs)} rows of {q}"
            )
        if not np.all(np.isfinite(first)):
            raise ModelError("initial has an output that is not finite; give measured rows")
        return self._shaped(self._free_run(inputs, first))

    def predict_ahead(
        self, X: Dataset | FloatArray, y: FloatArray | None = None, k: int = 1
    ) -> FloatArray:
        """Predictions k samples ahead: row t from outputs up to row t-k and inputs up to row t.

        X, y: a Dataset, or the arrays of one record. Lost outputs (NaN) are bridged by their
        prediction. The model starts from rest, so that k >= n_samples gives ``simulate(X)``; no
        noise is read off the first ``n_lags_`` rows. Ljung, System Identification, section 3.2.
        """
        self._check_fitted()
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
            raise ModelError(f"k is {k!r}; predict 1 or more whole samples ahead")
        datasets = given_datasets(X)
        record = self._checked(datasets or self._arrays(X, y, None, None, reset=False))
        first, drive = self.n_lags_, self._drive(record.inputs)
        y = self._after_rest(self.output_mean_, self._filled(record.outputs[:first]))
        past = y[: len(y) - first]
        outputs, errors = innovations(self.A_, self.C_, drive[first:], y, record.outputs[first:])
        y, e = np.vstack((y, outputs)), np.vstack((np.zeros_like(y), errors))
        steps: list[FloatArray] = []
        for step in range(1, min(k, len(drive)) + 1):
            prediction = drive.copy()
            for lag in range(1, len(self.A_)):
                # Outputs younger than ``step`` rows are predictions themselves.
                source = steps[-lag] if lag < step else y
                prediction -= source[len(past) - lag :][: len(drive)] @ self.A_[lag].T
            for lag in range(step, len(self.C_)):
                prediction += self.C_[lag] * e[len(past) - lag :][: len(drive)]
            steps = [*steps, np.vstack((past, prediction))][-len(self.A_) :]
        return prediction if datasets else self._shaped(prediction)

    def score(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None, dt: float | None = None
    ) -> float:
        """Mean fit % of free runs, as ``predict`` of a Dataset, divided by 100; 1 is perfect."""
        self._check_fitted()
        data = given_datasets(X) or self._arrays(X, y, records, dt, reset=False)
        fits = [free_run_fit(r.outputs, self._fitted_run(self._checked([r])))[0] for r in data]
        return float(np.nanmean(fits)) / 100.0

    def _layout(self, record: Dataset) -> Layout:
        orders = {name: getattr(self, name, 0) for name in ("na", "nb", "nc", "nk")}
        return Layout(record.outputs.shape[1], record.inputs.shape[1], offset=self.offset, **orders)

    def _fit_rows(
        self, lag: int, X: Data, y: Any = None, records: Any = None, dt: float | None = None
    ) -> None:
        """Fit each record's rows but the first ``lag``, or more if more lack a complete past."""
        self.dt_ = dt
        data = self._records(X, y, records, dt, reset=True)
        if given_datasets(X) is not None:
            check_alike(data)
            self.dt_ = data[0].dt
        layout, stack = self._layout(data[0]), Stack(data)
        lag, limit = max(lag, layout.lag), getattr(self, "max_iterations", 1)
        if limit < 1:
            raise ModelError(f"max_iterations is {limit}; it must be 1 or more")
        fits = self._fits(data, stack, layout, lag, limit)
        self.theta_ = np.concatenate([np.append(fit.theta, fit.c) for fit in fits])
        A = layout.polynomials(self.theta_)[0]
        self.A_ = reflect_poles(A) if self.stable else A
        self.reflected_ = self.A_ is not A  # reflect_poles returns a stable A itself
        estimated = np.full(len(self.theta_), True)
        if self.reflected_:
            rows = zip(stack.equations(layout, lag, self.A_), fits, strict=True)
            fits = [fit_equation(row, len(fit.c), [fit.c], limit) for row, fit in rows]
            estimated = np.nonzero(layout.free)[1] >= len(fits)
            free_of_A = layout.free[:, : len(fits), : len(A)]
            self.theta_[~estimated] = self.A_.transpose(1, 2, 0)[free_of_A]
            self.theta_[estimated] = np.concatenate([np.append(fit.theta, fit.c) for fit in fits])
        _, self.B_, self.C_, self.offset_ = layout.polynomials(self.theta_)
        self._set_precision(layout, fits, estimated, len(stack.age))
        self.n_lags_, self.names_, self.poles_ = layout.lag, layout.names, poles(self.A_)
        self.radius_ = float(np.abs(self.poles_).max(initial=0.0))
        self.stable_ = self.radius_ < 1.0
        self.iterations_ = tuple(fit.iterations for fit in fits)
        self.converged_ = all(fit.converged for fit in fits)
        self.input_mean_ = self.offset * np.vstack([r.inputs for r in data]).mean(axis=0)
        self.output_mean_ = self.offset * np.nanmean(stack.outputs, axis=0)

    def _fits(
        self, data: list[Dataset], stack: Stack, layout: Layout, lag: int, limit: int
    ) -> list[Fit]:
        """The best coefficients of each output's equation."""
        equations = stack.equations(layout, lag)
        starts = stack.first_guesses(layout, equations)
        return [fit_equation(*row, limit) for row in zip(equations, layout.nc, starts, strict=True)]

    def _set_precision(
        self, layout: Layout, fits: Sequence[Fit], estimated: BoolArray, n: int
    ) -> None:
        """Set covariances, standard errors and likelihood; Ljung, sections 9.2 and 9.3."""
        row, q, p = np.nonzero(layout.free)[0], len(fits), len(estimated)
        # Over all n instants: errors of several outputs at the same instant may be correlated.
        present, residual, gain = np.zeros((q, n)), np.zeros((q, n)), np.zeros((p, n))
        used, determined = np.zeros(q), estimated.copy()
        for i, fit in enumerate(fits):
            fitted = np.flatnonzero(estimated & (row == i))
            effect, basis, determined[fitted] = influence(fit.sensitivity)
            gain[np.ix_(fitted, fit.position)], used[i] = effect, basis.shape[1] / 2.0
            present[i, fit.position], residual[i, fit.position] = 1.0, fit.residual
        # Instants shared by two outputs, less the mean number of their coefficients.
        degrees_of_freedom = np.maximum(present @ present.T - used - used[:, None], 1.0)
        self.noise_covariance_ = residual @ residual.T / degrees_of_freedom
        self.covariance_ = self.noise_covariance_[row[:, None], row] * (gain @ gain.T)
        self.covariance_[~determined] = self.covariance_[:, ~determined] = np.nan
        undetermined = np.flatnonzero(estimated & ~determined)
        self.covariance_[undetermined, undetermined] = np.inf
        deviations = np.sqrt(np.diag(self.covariance_))
        self.A_std_, self.B_std_, self.C_std_, self.offset_std_ = layout.polynomials(deviations, 0)
        self.residuals_ = tuple(fit.errors for fit in fits)
        self.loss_ = np.array([np.mean(fit.residual**2) for fit in fits])
        shared = residual[:, present.all(axis=0)]
        self.n_rows_ = shared.shape[1]
        sign, log_det = np.linalg.slogdet(shared @ shared.T / max(self.n_rows_, 1))
        self.log_likelihood_ = np.inf if self.n_rows_ else np.nan
        if sign > 0:
            log_det += q * np.log(2.0 * np.pi) + q
            past = sum(fit.log_det for fit in fits)
            self.log_likelihood_ = float(-0.5 * (self.n_rows_ * log_det + past))
        self.aic_ = 2.0 * p - 2.0 * self.log_likelihood_
        self.bic_ = np.log(max(self.n_rows_, 1)) * p - 2.0 * self.log_likelihood_

    def _step(self, dt: float | None) -> float:
        step = self.dt_ if dt is None else dt
        return 1.0 if step is None else step

    def _checked(self, records: list[Dataset]) -> Dataset:
        """The only record; ModelError for several, or for other signals than the model's."""
        if len(records) > 1:
            raise ModelError("predictions take one Dataset at a time; call for each")
        check_signals(records[0], (len(self.input_mean_), len(self.offset_)), self.dt_, "the model")
        return records[0]

    def _drive(self, inputs: FloatArray) -> FloatArray:
        """B(q) u + offset of each row, (n, q)."""
        u = self._after_rest(self.input_mean_, inputs)
        return filtered(self.B_, u)[-len(inputs) :] + self.offset_

    def _after_rest(self, rest: FloatArray, rows: FloatArray) -> FloatArray:
        """Rows of a record, after as many rows at rest as the longest lag needs."""
        return np.vstack((np.tile(rest, (max(len(self.A_), len(self.B_), len(self.C_)), 1)), rows))

    def _filled(self, outputs: FloatArray) -> FloatArray:
        """Outputs with lost samples replaced: by the last before, the first after, or the mean."""
        filled = outputs.copy()
        for column, mean in zip(filled.T, self.output_mean_, strict=True):
            last = next(iter(column[np.isfinite(column)]), mean)
            for row, value in enumerate(column):
                last = column[row] = value if np.isfinite(value) else last
        return filled

    def _free_run(self, inputs: FloatArray, initial: FloatArray | tuple[()] = ()) -> FloatArray:
        """Free run, (n, q). initial: (k, q) outputs of the first rows, kept as they are."""
        first = np.reshape(initial, (-1, len(self.offset_)))
        past = self._after_rest(first[0] if len(first) else self.output_mean_, first)
        outputs, _ = innovations(self.A_, self.C_, self._drive(inputs)[len(first) :], past)
        return np.vstack((first, outputs))

    def _fitted_run(self, record: Dataset) -> FloatArray:
        """Free run, (n, q), whose ``n_lags_`` first rows are fitted to explain the record best."""
        first, na, q = self.n_lags_, len(self.A_) - 1, len(self.offset_)
        base = self._free_run(record.inputs, self._filled(record.outputs[:first]))
        residual = record.outputs - base
        seen = np.isfinite(residual)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.where(seen, residual, 0.0)[first:] ** 2
            unit = np.sqrt(squares.sum(axis=0) / max(len(squares), 1))
        if not first or not np.all((unit > 0.0) & (unit < np.inf)):
            return base
        # Responses to a unit in each value of those rows, an output's unit its residual's RMS.
        responses = np.zeros((na * q, len(base), q))
        for run, start in zip(responses, np.eye(na * q), strict=True):
            run[first - na : first] = unit * start.reshape(na, q)
            run[first:] = innovations(self.A_, self.C_, run[first:], run[first - na : first])[0]
        responses /= unit
        if not np.all(np.abs(responses) < _UNSTABLE_GROWTH):
            return base
        start = np.linalg.lstsq(responses[:, seen].T, (residual / unit)[seen])[0]
        return np.asarray(base + unit * np.tensordot(start, responses, axes=1), dtype=np.float64)


def free_run_fit(measured: FloatArray, simulated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit %, minus infinity for a run that is not finite, and RMSE; each (n_outputs,)."""
    with np.errstate(all="ignore"):
        metrics = evaluate(measured, simulated)
    return np.where(np.isfinite(simulated).all(axis=0), metrics.fit, -np.inf), metrics.rmse


def check_alike(records: list[Dataset]) -> None:
    """Raise ModelError unless all have the same signals and sample time."""
    first = records[0]
    for record in records:
        check_signals(record, (first.inputs.shape[1], first.outputs.shape[1]), first.dt, first.name)


def check_signals(record: Dataset, shape: tuple[int, int], dt: float | None, name: str) -> None:
    """Raise ModelError unless a record has these numbers of inputs and outputs, and this dt [s]."""
    n_inputs, n_outputs = record.inputs.shape[1], record.outputs.shape[1]
    if (n_inputs, n_outputs) != shape:
        raise ModelError(
            f"{record.name}: {n_inputs} inputs and {n_outputs} outputs, but {name} has "
            f"{shape[0]} and {shape[1]}; give records of the same signals"
        )
    if dt is not None and not np.isclose(record.dt, dt, rtol=1e-6, atol=0.0):
        raise ModelError(
            f"{record.name}: its sample time is {record.dt} s, that of {name} {dt} s; a "
            "difference equation holds for one sample time, so resample the record"
        )


@dataclass(repr=False, eq=False)
class ARX(PolynomialModel):
    """Identify y(t) + A_1 y(t-1) + ... = B_nk u(t-nk) + ... + offset + e(t) by least squares.

    A and B are full. Biased when the noise is not white; ``ARMAX`` models its colour. Ljung,
    System Identification, sections 4.2 and 10.1.

    Parameters
    ----------
    na : lags of the outputs: one number, or (n_outputs, n_outputs), a row for each equation.
    nb : coefficients of the inputs: one number, or (n_outputs, n_inputs).
    nk : samples before an input first acts, as nb. 1 where a row's outputs are latched before
        its inputs are applied (see ``Dataset``); 0 lets an input act on its own row.
    offset : estimate a constant for each equation, which carries the operating point.
    stable : mirror unstable poles in the unit circle and estimate B and offset again.

    Attributes
    ----------
    A_, B_ : (n_lags + 1, n_outputs, n_outputs) and (n_lags + 1, n_outputs, n_inputs), by lag.
    C_, offset_ : (nc + 1, n_outputs), the diagonal of C by lag, and (n_outputs,).
    A_std_, B_std_, C_std_, offset_std_ : standard errors; infinite if undetermined, NaN if moved.
    theta_, names_, covariance_ : all coefficients (n,), their names (``a2[0,1]`` weighs
        y_1(t-2) in the equation of y_0) and covariance (n, n).
    residuals_, loss_ : per output, the estimate of e in each row fitted, and its mean square, e
        before each record included. noise_covariance_: (n_outputs, n_outputs).
    log_likelihood_, aic_, bic_ : Gaussian, over the n_rows_ instants known for every output.
    poles_, radius_, stable_ : roots of det A, the largest one's size, whether that is below 1.
    reflected_ : whether ``stable`` had to move poles.
    input_mean_, output_mean_ : operating point of the start; zero with offset=False.
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


@dataclass(repr=False, eq=False)
class ARMAX(PolynomialModel):
    """Identify A(q) y = B(q) u + offset + C(q) e by minimising one-step prediction errors.

    A and B are full, C is diagonal with its roots inside the unit circle. The noise before a
    record, or after a gap, is as unknown as any other (``sysid.linear.prediction_error``).

    Parameters
    ----------
    na, nb, nk, offset, stable : as of ``ARX``; with ``stable``, C is estimated again too.
    nc : lags of the noise: one number, or (n_outputs,).
    max_iterations : limit of the iterations that search each output's C.

    Attributes
    ----------
    iterations_, converged_ : iterations by output; whether all converged. The rest as of ``ARX``.

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
    max_iterations: int = 50


def _rows(order: Any, m: int) -> Any:
    """A number for each output as a row of m; other orders as they are."""
    return [[number] * m for number in order] if np.ndim(order) == 1 else order


@dataclass(repr=False, eq=False)
class OE(PolynomialModel):
    """Identify y = B(q) / F(q) u + e by minimising the error of the free run, output by output.

    What ``ARMAX`` with C = A is when all that is not simulated is noise on the sensors: no other
    linear model of these orders has a smaller free-run error on the records of ``fit``. F is
    common to an output's inputs, its roots always inside the unit circle. Standard errors hold for
    white e. See ``sysid.linear.output_error``.

    Parameters
    ----------
    nf : coefficients of F: one number, or (n_outputs,).
    nb, nk : as of ``ARX``; or (n_outputs,), one number for all inputs of an output.
    offset : as of ``ARX``.
    max_iterations : limit of the evaluations that search each output's F.

    Attributes
    ----------
    A_, B_, C_ : F on the diagonal of A, and as C: predictions of any horizon are the free run.
    iterations_, converged_ : as of ``ARMAX``. The rest as of ``ARX``.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> u, e = np.random.default_rng(0).normal(size=(2, 500))
    >>> y = lfilter([0.0, 0.2], [1.0, -0.9], u) + 0.1 * e
    >>> model = OE(nf=1, nb=1).fit(u[:, None], y)
    >>> model.A_[1, 0].round(2), model.B_[1, 0].round(2)
    (array([-0.9]), array([0.2]))
    """

    nf: Order = 2
    nb: Order = 2
    nk: Order = 1
    _: KW_ONLY
    max_iterations: int = 100

    separate: ClassVar[bool] = True

    def _layout(self, record: Dataset) -> Layout:
        q, m = record.outputs.shape[1], record.inputs.shape[1]
        nf, nb, nk = order_table("nf", self.nf, (q,)), *(_rows(o, m) for o in (self.nb, self.nk))
        return Layout(q, m, na=np.diag(nf), nb=nb, nc=0, nk=nk, offset=self.offset)

    def _fits(
        self, data: list[Dataset], stack: Stack, layout: Layout, lag: int, limit: int
    ) -> list[Fit]:
        fits: list[Fit] = []
        for j, (free, nf) in enumerate(zip(layout.free, np.diag(layout.na), strict=True)):
            drive = Drive(data, j, free[len(layout.free) : -1], int(nf), lag)
            fits.append(fit_output_error(drive, int(nf), limit))
        return fits

    def _fit_rows(self, *args: Any, **more: Any) -> None:
        super()._fit_rows(*args, **more)
        self.C_ = np.einsum("lii->li", self.A_)
        self.C_std_ = np.einsum("lii->li", self.A_std_)
