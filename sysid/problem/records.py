"""What a user hands to an estimator, arrays or Datasets, as a list of records."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_array, validate_data

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError

Data = Dataset | Sequence[Dataset] | FloatArray


def given_datasets(X: Any) -> list[Dataset] | None:
    """The records if X is one Dataset or several, None if it is an array."""
    if isinstance(X, Dataset):
        return [X]
    if isinstance(X, list | tuple) and X and all(isinstance(item, Dataset) for item in X):
        return list(X)
    return None


def split(n: int, labels: Any) -> list[slice]:
    """Rows of each record. labels: (n,), one for each row, default all of one record.

    Raises ModelError for another length, or for a label that returns after another one.
    """
    if labels is None:
        return [slice(0, n)]
    values = np.asarray(labels)
    if values.shape != (n,):
        raise ModelError(
            f"records has shape {values.shape} for {n} rows; give the record of each row: ({n},)"
        )
    starts = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist()]
    if len(np.unique(values)) != len(starts):
        raise ModelError(
            "the rows of a record must follow each other: sort the rows by record, then by time"
        )
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], n], strict=True)]


class RecordEstimator(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A scikit-learn regressor whose rows are samples in time."""

    _flat = False  # whether the outputs of ``fit`` were one-dimensional

    def _step(self, dt: float | None) -> float:
        """Sample time [s] of arrays, given as ``dt`` or otherwise known."""
        raise NotImplementedError

    def _records(
        self, X: Any, y: Any, records: Any, dt: float | None, reset: bool
    ) -> list[Dataset]:
        """Datasets as they are, arrays as Datasets. reset: whether this is ``fit``."""
        data = given_datasets(X)
        if reset:
            self._flat = False
        if data is None:
            return self._arrays(X, y, records, dt, reset)
        if y is not None:
            raise ModelError("Datasets bring their outputs: leave y out")
        if reset and data[0].inputs.shape[1] > 0:
            self._inputs(data[0].inputs, reset=True)
        elif reset:
            # A free motion: scikit-learn knows no table without columns.
            self.n_features_in_ = 0
        return data

    def _arrays(self, X: Any, y: Any, records: Any, dt: float | None, reset: bool) -> list[Dataset]:
        inputs = self._inputs(X, reset)
        name = type(self).__name__
        if y is None:
            raise ModelError(
                f"{name} requires y to be passed, but the target y is None: give Datasets, or "
                "the outputs as y"
            )
        outputs = check_array(
            y, ensure_2d=False, ensure_all_finite="allow-nan", dtype=np.float64, input_name="y",
            estimator=name,
        )  # fmt: skip
        if reset:
            self._flat = outputs.ndim == 1
        if len(inputs) != len(outputs):
            raise ModelError(
                f"{len(inputs)} rows of inputs, {len(outputs)} of outputs: row k of both must "
                "belong to the same instant"
            )
        step = self._step(dt)
        return [
            Dataset(inputs[rows], outputs[rows], step, f"record {number}")
            for number, rows in enumerate(split(len(inputs), records))
        ]

    def _inputs(self, X: Any, reset: bool) -> FloatArray:
        inputs: FloatArray = validate_data(
            self, X, reset=reset, dtype=np.float64, ensure_min_samples=2 if reset else 1
        )
        return inputs

    def _shaped(self, outputs: FloatArray) -> FloatArray:
        return outputs[:, 0] if self._flat else outputs

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags
