"""Parameters that an earlier identification found, with their covariance.

Found in stages, such as a motor alone and then with its brake, the later stage keeps what the
earlier found, and its own intervals include how well that was known.
"""

import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.model import ModelError, ProcessModel


class Given(NamedTuple):
    """Values of parameters, and a factor of their covariance.

    factor: rows of independent changes of one standard deviation each, a number for each value in
    their order and unit. The covariance is factor' factor.

    >>> Given({"R": 1.2, "L": 1e-3}, [[0.01, 0.0], [0.0, 2e-5]]).values["R"]
    1.2
    """

    values: Mapping[str, float]
    factor: Sequence[Sequence[float]] = ()

    def check(self, model: ProcessModel, fixed: Collection[str] = ()) -> None:
        """Raise ModelError for a name the model has not or that is fixed, or a factor that is none.

        fixed: names of parameters whose value comes from elsewhere.
        """
        for name in self.values:
            model.parameter(name)
            if name in fixed:
                raise ModelError(f"parameter {name} is both fixed and given; leave one out")
        if any(len(row) != len(self.values) for row in self.factor):
            raise ModelError(
                f"the rows of a given factor must have {len(self.values)} numbers, one for each "
                "value"
            )
        if not np.all(np.isfinite([*self.values.values(), *itertools.chain(*self.factor)])):
            raise ModelError("'given' has a number that is not finite")

    def changes(self, model: ProcessModel) -> FloatArray:
        """The rows as changes of a model's whole parameter vector, (n, n_parameters)."""
        changes = np.zeros((len(self.factor), len(model.parameters)))
        places = [model.parameter_names.index(name) for name in self.values]
        changes[:, places] = np.reshape(self.factor, (len(self.factor), len(places)))
        return changes


def covariance_factor(
    covariance: FloatArray, ties: FloatArray, increments: FloatArray
) -> FloatArray:
    """Independent changes (n, n_free) of identified parameters, one standard deviation each.

    covariance: (n_free, n_free), of coordinates that ``increments`` (n_free,) turn into the
    parameters' units. ties: (k, n_free), directions of which the data tell nothing: a unit of each
    stands for its infinite deviation.
    """
    values, vectors = np.linalg.eigh(covariance)
    strong = values > 1e-12 * max(values[-1], 0.0)
    rows = np.concatenate([(vectors[:, strong] * np.sqrt(values[strong])).T, ties])
    return np.asarray(rows * increments, dtype=np.float64)
