"""Families of excitations, from which a design chooses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from sysid.arrays import FloatArray
from sysid.experiments.feedback import Feedback
from sysid.problem.model import ModelError, check_range


@dataclass(frozen=True)
class Setting:
    """A free setting of an excitation, between two ends.

    log: whether it is drawn by its logarithm; whole: whether it is a whole number, such as a seed.
    calm: the value towards which it excites less, to which it is drawn where a run would pass a
    limit; None where no value does.

    >>> Setting(0.01, 1.0, log=True).value(0.5).__round__(3)
    0.1
    """

    low: float
    high: float
    log: bool = False
    whole: bool = False
    calm: float | None = None

    def __post_init__(self) -> None:
        check_range("of a setting", self.low, self.high, "log" if self.log else "linear")

    def towards_calm(self, gene: float) -> float:
        """A place in its range, halfway to where it excites less."""
        if self.calm is None or self.log:
            return gene
        return 0.5 * (gene + (self.calm - self.low) / (self.high - self.low))

    def value(self, gene: float) -> float:
        """The value at a place in its range, 0 at the low end and 1 at the high one."""
        if self.log:
            value = self.low * (self.high / self.low) ** gene
        else:
            value = self.low + (self.high - self.low) * gene
        return float(round(value)) if self.whole else value


@dataclass(frozen=True)
class Excitation:
    """A family of runs: inputs as a function of free settings.

    inputs: of settings by name, (n_samples, n_inputs) in the order of the model's inputs (or
    what else the ``Bench`` of a design takes), or what makes them of the outputs while it runs.
    dt: sample time [s].

    >>> steps = Excitation(
    ...     "step", {"height": Setting(-1.0, 1.0)}, lambda s: np.full((50, 1), s["height"]), 0.01
    ... )
    >>> steps.at(np.array([0.75]))
    {'height': 0.5}
    """

    name: str
    settings: Mapping[str, Setting]
    inputs: Callable[[Mapping[str, float]], FloatArray | Feedback]
    dt: float

    def at(self, genes: FloatArray) -> dict[str, float]:
        """Settings at places (n_settings,) in their ranges."""
        pairs = zip(self.settings.items(), genes.tolist(), strict=True)
        return {name: setting.value(gene) for (name, setting), gene in pairs}

    def calmer(self, genes: FloatArray) -> FloatArray:
        """Places in the ranges of the settings at which they excite less, (n_settings,)."""
        pairs = zip(self.settings.values(), genes.tolist(), strict=True)
        return np.array([setting.towards_calm(gene) for setting, gene in pairs])

    def signal(self, genes: FloatArray) -> FloatArray | Feedback:
        """Inputs at places in the ranges of the settings, (n_samples, n_inputs), or a feedback."""
        settings = self.at(genes)
        inputs = self.inputs(settings)
        if isinstance(inputs, Feedback):
            return inputs
        signal = np.asarray(inputs, dtype=np.float64)
        if signal.ndim != 2 or len(signal) < 2 or not np.isfinite(signal).all():
            raise ModelError(
                f"excitation {self.name} at {settings}: its inputs have shape {signal.shape}; "
                "return (n_samples, n_inputs) finite numbers, two samples at least"
            )
        return signal
