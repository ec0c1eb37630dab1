"""What ARX and ARMAX share: identification, free runs and predictions of a linear model."""

import warnings
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sysid.arrays import BoolArray, FloatArray
from sysid.linear.polynomials import Layout, Order, filtered, innovations, poles, reflect_poles
from sysid.linear.prediction_error import EquationFit, Stack, first_guesses, fit_equation, influence
from sysid.problem.data import Dataset
from sysid.problem.metrics import evaluate
from sysid.problem.model import ModelError
from sysid.problem.records import Data, RecordEstimator, given_datasets, split
from sysid.threads import one_thread

# A response to a start beyond this many times the start is that of an unstable model.
_GROWN = 1e6


class PolynomialModel(RecordEstimator):
    """A(q) y = B(q) u + offset + C(q) e, resting at an operating point before each record."""

    nc: Order = 0
    offset: bool
    stable: bool
    max_iterations = 1

    def fit(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None, dt: float | None = None
    ) -> Self:
        """Estimate the coefficients from one record or several; warns if the model is unstable.

        X: one Dataset, several of any lengths, or an (n_samples, n_inputs) array with y
        (n_samples,) or (n_samples, n_outputs), NaN where a sample was lost. records: (n_samples,),
        which record each row of the arrays belongs to, default one. dt: sample time [s] of the
        arrays, to refuse Datasets of another one. Raises ModelError for senseless orders or data.
        """
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

        A Dataset starts from the values of its first ``n_lags_`` rows that make the whole record
        fit best, so that noise in those rows does no harm. An array X starts from rest like
        ``simulate``, each of its ``records`` anew; (n_samples,) if the outputs of ``fit`` were.
        """
        check_is_fitted(self)
        datasets = given_datasets(X)
        if datasets is not None:
            return self._follow(self._single(datasets))
        inputs = self._inputs(X, reset=False)
        runs = [self._free_run(inputs[rows]) for rows in split(len(inputs), records)]
        return self._shaped(np.concatenate(runs))

    def simulate(self, X: FloatArray, initial: FloatArray | None = None) -> FloatArray:
        """Free run from the inputs alone, without noise; (n_samples, n_outputs).

        X: (n_samples, n_inputs). initial: (k, n_outputs), outputs of the first k rows, returned
        as they are; ``n_lags_`` of them define the start completely. Before the first row inputs
        are at ``input_mean_`` and outputs at ``initial[0]``, by default ``output_mean_``.
        """
        check_is_fitted(self)
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
        """Row t: outputs predicted from those up to row t-k and the inputs up to row t.

        X, y: one Dataset, or arrays (n_samples, n_inputs) and (n_samples, n_outputs) of one
        record. Lost outputs (NaN) are bridged by their prediction. The model starts from rest, so
        that k >= n_samples gives ``simulate(X)``; no noise is read off the first ``n_lags_`` rows,
        which have no complete past. Ljung, System Identification, section 3.2.
        """
        check_is_fitted(self)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
            raise ModelError(f"k is {k!r}; predict 1 or more whole samples ahead")
        datasets = given_datasets(X)
        record = self._single(datasets or self._arrays(X, y, None, None, reset=False))
        first, drive, past = self.n_lags_, self._drive(record.inputs), self._rest(self.output_mean_)
        y = np.vstack((past, self._held(record.outputs[:first])))
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
        """Mean fit % / 100 of free runs like ``predict`` of a Dataset; 1 is perfect."""
        check_is_fitted(self)
        data = given_datasets(X) or self._arrays(X, y, records, dt, reset=False)
        runs = [(record.outputs, self._follow(self._single([record]))) for record in data]
        return float(np.nanmean([free_run_fit(*run)[0] for run in runs])) / 100.0

    def _layout(self, record: Dataset) -> Layout:
        orders = {name: getattr(self, name) for name in ("offset", "na", "nb", "nc", "nk")}
        return Layout(record.outputs.shape[1], record.inputs.shape[1], **orders)

    @one_thread()
    def _fit_rows(
        self, lag: int, X: Data, y: Any = None, records: Any = None, dt: float | None = None
    ) -> None:
        """Minimise each output's prediction errors over the coefficients of its equation.

        lag: rows left out at the start of each record, to compare orders on the same rows.
        """
        self.dt_ = dt
        data = self._records(X, y, records, dt, reset=True)
        if given_datasets(X) is not None:
            check_alike(data)
            self.dt_ = data[0].dt
        layout, stack = self._layout(data[0]), Stack.of(data)
        if self.max_iterations < 1:
            raise ModelError(f"max_iterations is {self.max_iterations}; it must be 1 or more")
        lag, limit = max(lag, layout.lag), self.max_iterations
        equations = stack.equations(layout, lag)
        starts = first_guesses(stack, layout, equations)
        fits = [fit_equation(*row, limit) for row in zip(equations, layout.nc, starts, strict=True)]
        self.theta_ = np.concatenate([np.append(fit.theta, fit.c) for fit in fits])
        A = layout.polynomials(self.theta_)[0]
        self.A_ = reflect_poles(A) if self.stable else A
        self.reflected_ = self.A_ is not A
        estimated = np.full(len(self.theta_), True)
        if self.reflected_:
            rows = zip(stack.equations(layout, lag, self.A_), fits, strict=True)
            fits = [fit_equation(row, len(fit.c), [fit.c], limit) for row, fit in rows]
            estimated = np.nonzero(layout.free)[1] >= len(fits)
            moved = layout.free[:, : len(fits), : len(A)]
            self.theta_[~estimated] = self.A_.transpose(1, 2, 0)[moved]
            self.theta_[estimated] = np.concatenate([np.append(fit.theta, fit.c) for fit in fits])
        _, self.B_, self.C_, self.offset_ = layout.polynomials(self.theta_)
        self._set_precision(layout, fits, estimated, len(stack.age))
        self.n_lags_, self.names_ = layout.lag, layout.names
        self.poles_ = poles(self.A_)
        self.radius_ = float(np.abs(self.poles_).max(initial=0.0))
        self.stable_ = self.radius_ < 1.0
        self.iterations_ = tuple(fit.iterations for fit in fits)
        self.converged_ = all(fit.converged for fit in fits)
        self.input_mean_ = self.offset * np.vstack([r.inputs for r in data]).mean(axis=0)
        self.output_mean_ = self.offset * np.nanmean(stack.outputs, axis=0)

    def _set_precision(
        self, layout: Layout, fits: Sequence[EquationFit], estimated: BoolArray, n: int
    ) -> None:
        """Of fits of the estimated coefficients to rows among n instants.

        Errors of several outputs at one instant may be correlated, although their equations are
        estimated apart. Ljung, System Identification, sections 9.2 and 9.3.
        """
        row, q, p = np.nonzero(layout.free)[0], len(fits), len(estimated)
        # Over all instants, zero at those that an equation was not fitted to.
        present, residual, gain = np.zeros((q, n)), np.zeros((q, n)), np.zeros((p, n))
        used, determined = np.zeros(q), estimated.copy()
        for i, fit in enumerate(fits):
            fitted = np.flatnonzero(estimated & (row == i))
            effect, basis, determined[fitted] = influence(fit.sensitivity)
            gain[np.ix_(fitted, fit.position)], used[i] = effect, basis.shape[1] / 2.0
            present[i, fit.position], residual[i, fit.position] = 1.0, fit.residual
        # Each error counts for its degrees of freedom.
        freedom = np.maximum(present @ present.T - used - used[:, None], 1.0)
        self.noise_covariance_ = residual @ residual.T / freedom
        self.covariance_ = self.noise_covariance_[row[:, None], row] * (gain @ gain.T)
        self.covariance_[~determined] = self.covariance_[:, ~determined] = np.nan
        self.covariance_[(estimated & ~determined,) * 2] = np.inf
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
        return dt if dt is not None else self.dt_ if self.dt_ is not None else 1.0

    def _single(self, records: list[Dataset]) -> Dataset:
        """The record to predict, of the model's signals."""
        if len(records) > 1:
            raise ModelError("predictions take one Dataset at a time; call for each")
        shape = len(self.input_mean_), len(self.offset_)
        check_signals(records[0], shape, self.dt_, "the model")
        return records[0]

    def _drive(self, inputs: FloatArray) -> FloatArray:
        """What inputs and offset add to each row's equation, (n, q)."""
        rest = self._rest(self.input_mean_)
        return filtered(self.B_, np.vstack((rest, inputs)))[-len(inputs) :] + self.offset_

    def _rest(self, row: FloatArray) -> FloatArray:
        """Rows before a record, all alike."""
        return np.tile(row, (max(len(self.A_), len(self.B_), len(self.C_)), 1))

    def _held(self, outputs: FloatArray) -> FloatArray:
        """Lost samples replaced by the last one before, else the first after, else the mean."""
        held = outputs.copy()
        for column, mean in zip(held.T, self.output_mean_, strict=True):
            last = next(iter(column[np.isfinite(column)]), mean)
            for row, value in enumerate(column):
                last = column[row] = value if np.isfinite(value) else last
        return held

    def _free_run(self, inputs: FloatArray, initial: FloatArray | tuple[()] = ()) -> FloatArray:
        """Free run, (n, q). initial: (k, q) outputs of the first rows, kept as they are."""
        first = np.reshape(initial, (-1, len(self.offset_)))
        past = np.vstack((self._rest(first[0] if len(first) else self.output_mean_), first))
        drive = self._drive(inputs)[len(first) :]
        return np.vstack((first, innovations(self.A_, self.C_, drive, past)[0]))

    def _follow(self, record: Dataset) -> FloatArray:
        """Free run whose first ``n_lags_`` rows are those that explain the record best, (n, q).

        By least squares on the response to them, each output in units of its residual; where
        that grows out of proportion, the run starts where it was measured.
        """
        first, na, q = self.n_lags_, len(self.A_) - 1, len(self.offset_)
        plain = self._free_run(record.inputs, self._held(record.outputs[:first]))
        residual = record.outputs - plain
        seen = np.isfinite(residual)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.where(seen, residual, 0.0)[first:] ** 2
            unit = np.sqrt(squares.sum(axis=0) / max(len(squares), 1))
        if not first or not np.all((unit > 0.0) & (unit < np.inf)):
            return plain
        # Free runs, in these units, from one in each value of those rows, without inputs.
        responses = np.zeros((na * q, len(plain), q))
        for run, start in zip(responses, np.eye(na * q), strict=True):
            run[first - na : first] = unit * start.reshape(na, q)
            run[first:] = innovations(self.A_, self.C_, run[first:], run[first - na : first])[0]
        responses /= unit
        if not np.all(np.abs(responses) < _GROWN):
            return plain
        start = np.linalg.lstsq(responses[:, seen].T, (residual / unit)[seen])[0]
        corrected: FloatArray = plain + unit * np.tensordot(start, responses, axes=1)
        return corrected


def free_run_fit(measured: FloatArray, simulated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit %, minus infinity for a run that went out of bounds, and RMSE; each (n_outputs,)."""
    with np.errstate(all="ignore"):
        metrics = evaluate(measured, simulated)
    return np.where(np.isfinite(simulated).all(axis=0), metrics.fit, -np.inf), metrics.rmse


def check_alike(records: Sequence[Dataset]) -> None:
    """Raise ModelError unless all have the same columns and sample time, and finite outputs."""
    first = records[0]
    for record in records:
        shape = first.inputs.shape[1], first.outputs.shape[1]
        check_signals(record, shape, first.dt, first.name)
        for row in np.flatnonzero(np.isinf(record.outputs).any(axis=1)):
            raise ModelError(
                f"{record.name}: an output is infinite in row {row}; mark lost samples with NaN"
            )


def check_signals(record: Dataset, shape: tuple[int, int], dt: float | None, name: str) -> None:
    """Raise ModelError unless a record has as many (inputs, outputs) and the dt [s] of another."""
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
