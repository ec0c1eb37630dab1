"""Plots that a process model brings, as data: what is drawn over what, and with which units.

A model that knows what its states mean can show more than its outputs, such as the torque of a
brake over its angle: ``ProcessModel(..., plots=plots)`` with a function of the model and an
``Evidence`` that gives ``Plot``s. It draws nothing itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sysid.arrays import BoolArray, FloatArray
from sysid.problem.data import Dataset


@dataclass(frozen=True)
class Quantity:
    """What stands along an axis."""

    name: str
    unit: str


@dataclass(frozen=True)
class Curve:
    """A curve through several quantities, (n,) each, by their names.

    band: the plotted quantity's lower and upper ends, (n,) each, by the parameters' uncertainty.
    beyond: (n,), where the data that the parameters come from did not reach.
    """

    label: str
    values: Mapping[str, FloatArray]
    band: tuple[FloatArray, FloatArray] | None = None
    beyond: BoolArray | None = None


@dataclass(frozen=True)
class Plot:
    """One quantity over each of several others: a panel for each of these.

    name: stem of its file. topic: section of a report, such as ``torque``. points: curves are
    clouds of measured samples.

    >>> import numpy as np
    >>> angle = np.linspace(0.0, 6.28, 100)
    >>> loop = Curve("a turn", {"angle": angle, "torque": np.sin(angle)})
    >>> Plot("torque", "torque", "One turn.", (Quantity("angle", "rad"),),
    ...      Quantity("torque", "N*m"), (loop,)).over[0].unit
    'rad'
    """

    name: str
    topic: str
    caption: str
    over: tuple[Quantity, ...]
    quantity: Quantity
    curves: tuple[Curve, ...]
    points: bool = False


@dataclass(frozen=True)
class Evidence:
    """What a model's plots are made from.

    parameters: all of them, in the model's order. records: the training records. log: the first
    log's columns by name, (n,) each, empty where it is not a log of the program's own. draws:
    parameters as plausible, drawn from their covariance, (n_draws, n_parameters); none of an
    identification without one.
    """

    parameters: FloatArray
    records: Sequence[Dataset]
    log: Mapping[str, FloatArray]
    draws: FloatArray
