"""What ARX and ARMAX share: the scikit-learn interface around identification and prediction."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sysid.arrays import FloatArray
from sysid.linear.identification import Coefficients, Estimate, identify
from sysid.linear.orders import Orders
from sysid.linear.polynomials import poles
from sysid.linear.predictor import Predictor
from sysid.linear.records import check_alike, check_columns, check_sample_time
from sysid.problem.data import Dataset
from sysid.problem.metrics import fit_percent
from sysid.problem.model import ModelError
from sysid.problem.records import Data, RecordEstimator, given_datasets, split
from sysid.threads import one_thread


class PolynomialModel(RecordEstimator):
    """A(q) y = B(q) u + offset + C(q) e, identified equation by equation."""

    offset: bool
    stable: bool

    def fit(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None, dt: float | None = None
    ) -> Self:
        """Estimate the coefficients from one record or several.

        X: one Dataset, several of any lengths, or an (n_samples, n_inputs) array with
        y (n_samples,) or (n_samples, n_outputs), NaN where a sample was lost. records:
        (n_samples,), which record each row of the arrays belongs to, default one record.
        dt: sample time [s] of the arrays, needed only to refuse Datasets of another one. Warns
        when the model is unstable. Raises ModelError for orders or data that make no sense.
        """
        with one_thread():
            self._identify(self._training_data(X, y, records, dt))
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
        fit best, by least squares with each output in units of its residual, so that noise in
        those rows does no harm. An array X starts from rest like ``simulate``, each
        of its ``records`` anew; the outputs are (n_samples,) if those of ``fit`` were.
        """
        check_is_fitted(self)
        datasets = given_datasets(X)
        if datasets is not None:
            return self._follow(_only(datasets))
        inputs = self._inputs(X, reset=False)
        parts = [self._predictor.run(inputs[rows]) for rows in split(len(inputs), records)]
        return self._shaped(np.concatenate(parts))

    def simulate(self, X: FloatArray, initial: FloatArray | None = None) -> FloatArray:
        """Free run from the inputs alone, without noise; (n_samples, n_outputs).

        X: (n_samples, n_inputs). initial: (k, n_outputs), outputs of the first k rows, returned
        as they are; ``n_lags_`` of them define the start completely. Before the first row inputs
        are at ``input_mean_`` and outputs at ``initial[0]``, without ``initial`` at
        ``output_mean_``: the model starts from rest at its operating point.
        """
        check_is_fitted(self)
        inputs = self._inputs(X, reset=False)
        if initial is not None:
            initial = self._initial(initial, len(inputs))
        return self._shaped(self._predictor.run(inputs, initial))

    def predict_ahead(
        self, X: Dataset | FloatArray, y: FloatArray | None = None, k: int = 1
    ) -> FloatArray:
        """Row t: outputs predicted from those up to row t-k and the inputs up to row t.

        X, y: one Dataset, or arrays (n_samples, n_inputs) and (n_samples, n_outputs) of one
        record. Lost outputs (NaN) are bridged by their prediction. Before the first row the model
        rests at its operating point, so that k >= n_samples gives ``simulate(X)``; the first
        ``n_lags_`` rows have no complete past, and no noise is read off them. Ljung, System
        Identification, section 3.2.
        """
        check_is_fitted(self)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or k < 1:
            raise ModelError(f"k is {k!r}; predict 1 or more whole samples ahead")
        given = given_datasets(X)
        record = _only(self._arrays(X, y, None, None, reset=False) if given is None else given)
        self._check(record)
        result = self._predictor.ahead(record.inputs, record.outputs, int(k))
        return self._shaped(result) if given is None else result

    def score(
        self, X: Data, y: FloatArray | None = None, *, records: Any = None, dt: float | None = None
    ) -> float:
        """Mean free-run fit % over outputs and records, divided by 100: 1 is perfect.

        Each record starts where it fits best, like ``predict`` of a Dataset.
        """
        check_is_fitted(self)
        data = given_datasets(X)
        if data is None:
            data = self._arrays(X, y, records, dt, reset=False)
        fits = [_fit(record.outputs, self._follow(record)) for record in data]
        return float(np.nanmean(fits)) / 100.0

    def _orders(self, n_outputs: int, n_inputs: int) -> Orders:
        raise NotImplementedError

    def _iterations(self) -> int:
        return 0

    def _identify(self, data: Sequence[Dataset], lag: int = 0) -> None:
        """Estimate and take over. lag: rows left out, to compare orders on the same rows."""
        orders = self._orders(data[0].outputs.shape[1], data[0].inputs.shape[1])
        found = identify(
            data,
            orders,
            lag=max(lag, orders.lag),
            stable=self.stable,
            max_iterations=self._iterations(),
        )
        self._take_model(orders, found, data)
        self._take_precision(orders, found)

    def _take_model(self, orders: Orders, found: Estimate, data: Sequence[Dataset]) -> None:
        model = found.coefficients
        self.A_, self.B_, self.C_, self.offset_ = model.A, model.B, model.C, model.offset
        self.n_lags_ = orders.lag
        self.poles_ = poles(model.A)
        self.radius_ = float(np.abs(self.poles_).max(initial=0.0))
        self.stable_ = self.radius_ < 1.0
        self.reflected_ = found.reflected
        self.input_mean_ = np.zeros(orders.n_inputs)
        self.output_mean_ = np.zeros(orders.n_outputs)
        if self.offset:
            self.input_mean_ = np.concatenate([record.inputs for record in data]).mean(axis=0)
            self.output_mean_ = np.nanmean(np.concatenate([r.outputs for r in data]), axis=0)
        self._predictor = Predictor(
            model.A, model.B, model.C, model.offset, self.input_mean_, self.output_mean_,
            orders.lag,
        )  # fmt: skip

    def _take_precision(self, orders: Orders, found: Estimate) -> None:
        self.theta_ = found.theta
        self.names_ = tuple(term.name(row) for row, term in orders.layout)
        self.covariance_ = found.covariance
        errors = np.sqrt(np.diag(found.covariance))
        spread = Coefficients.of(orders, errors, leading=0.0)
        self.A_std_, self.B_std_ = spread.A, spread.B
        self.C_std_, self.offset_std_ = spread.C, spread.offset
        self.residuals_ = found.errors
        self.noise_covariance_ = found.noise_covariance
        self.loss_ = found.loss
        self.log_likelihood_ = found.log_likelihood
        self.n_rows_ = found.n_rows
        self.aic_ = 2.0 * len(found.theta) - 2.0 * found.log_likelihood
        self.bic_ = np.log(max(found.n_rows, 1)) * len(found.theta) - 2.0 * found.log_likelihood
        self.iterations_ = found.iterations
        self.converged_ = found.converged

    def _training_data(self, X: Any, y: Any, records: Any, dt: float | None) -> list[Dataset]:
        self.dt_ = dt
        data = self._records(X, y, records, dt, reset=True)
        if given_datasets(X) is not None:
            check_alike(data)
            self.dt_ = data[0].dt
        return data

    def _step(self, dt: float | None) -> float:
        return dt if dt is not None else self.dt_ if self.dt_ is not None else 1.0

    def _initial(self, initial: FloatArray, n: int) -> FloatArray:
        outputs = np.asarray(initial, dtype=np.float64)
        q = len(self.offset_)
        if outputs.ndim < 2:
            outputs = outputs.reshape(-1, q) if outputs.size % q == 0 else outputs.reshape(1, -1)
        if outputs.ndim != 2 or outputs.shape[1] != q or not 1 <= len(outputs) <= n:
            raise ModelError(
                f"initial has shape {np.shape(initial)}; give the outputs of the first rows, one "
                f"to {n} rows of {q}"
            )
        if not np.all(np.isfinite(outputs)):
            raise ModelError("initial has an output that is not finite; give measured rows")
        return outputs

    def _check(self, record: Dataset) -> None:
        check_columns(record, len(self.input_mean_), len(self.offset_), "the model")
        if self.dt_ is not None:
            check_sample_time(record, self.dt_, "the model")

    def _follow(self, record: Dataset) -> FloatArray:
        self._check(record)
        return self._predictor.follow(record.inputs, record.outputs)


def _only(records: list[Dataset]) -> Dataset:
    if len(records) > 1:
        raise ModelError("predictions take one Dataset at a time; call for each")
    return records[0]


def _fit(measured: FloatArray, simulated: FloatArray) -> FloatArray:
    """Fit %, minus infinity for a simulation that went out of bounds."""
    bounded = np.isfinite(simulated).all(axis=0)
    with np.errstate(all="ignore"):
        return np.where(bounded, fit_percent(measured, simulated), -np.inf)
