"""Estimators of records, and what a user hands to them, arrays or Datasets.

They are estimators of scikit-learn's kind that do not import it, which takes a second: of its
tools only arrays need any, and all of them take such estimators
(https://scikit-learn.org/stable/developers/develop.html).
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, ClassVar, Self

import numpy as np

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


class RecordEstimator:
    """A regressor of scikit-learn's kind whose rows are samples in time; a dataclass of settings.

    It is fitted once it has what ``fitted`` names.
    """

    fitted: ClassVar[str]
    _flat = False  # whether the outputs of ``fit`` were one-dimensional

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The settings by name; ``deep`` changes nothing: none is an estimator."""
        return {name: getattr(self, name) for name in _settings(self)}

    def set_params(self, **settings: Any) -> Self:
        """Change settings in place; ValueError for what is none."""
        for name, value in settings.items():
            if name not in _settings(self):
                raise ValueError(
                    f"Invalid parameter {name!r} for estimator {self}: it has "
                    f"{', '.join(_settings(self))}"
                )
            setattr(self, name, value)
        return self

    def like(self, **settings: Any) -> Self:
        """A new estimator, not fitted, with its settings but for those given."""
        return type(self)(**self.get_params()).set_params(**settings)

    def __repr__(self) -> str:
        plain = {field.name: field.default for field in _settings(self).values()}
        changed = [
            f"{name}={value!r}"
            for name, value in self.get_params().items()
            if value is not plain[name] and repr(value) != repr(plain[name])
        ]
        return f"{type(self).__name__}({', '.join(changed)})"

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, self.fitted)

    def _check_fitted(self) -> None:
        if not self.__sklearn_is_fitted__():
            from sklearn.exceptions import NotFittedError

            raise NotFittedError(f"{type(self).__name__} is not fitted yet: call fit first")

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
        if reset:
            self.n_features_in_ = data[0].inputs.shape[1]
            vars(self).pop("feature_names_in_", None)  # of an earlier fit to a table
        return data

    def _arrays(self, X: Any, y: Any, records: Any, dt: float | None, reset: bool) -> list[Dataset]:
        inputs = self._inputs(X, reset)
        name = type(self).__name__
        if y is None:
            raise ModelError(
                f"{name} requires y to be passed, but the target y is None: give Datasets, or "
                "the outputs as y"
            )
        from sklearn.utils.validation import check_array

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
        from sklearn.utils.validation import validate_data

        inputs: FloatArray = validate_data(
            self, X, reset=reset, dtype=np.float64, ensure_min_samples=2 if reset else 1
        )
        return inputs

    def _shaped(self, outputs: FloatArray) -> FloatArray:
        return outputs[:, 0] if self._flat else outputs

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        target = TargetTags(required=True, multi_output=True)
        return Tags("regressor", target, regressor_tags=RegressorTags(), input_tags=InputTags())


def _settings(estimator: Any) -> dict[str, Any]:
    """The fields of an estimator's settings by name."""
    return {field.name: field for field in fields(estimator) if field.init}
