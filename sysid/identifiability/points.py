"""Points in parameter space at which a model is looked at: near its nominal values, or anywhere."""

import math
from collections.abc import Callable

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.model import AROUND_FIRST_SAMPLE, Parameter, ProcessModel, State

_NEAR = 0.7  # logarithm by which parameters move about their nominal values
_FEASIBLE = 200  # draws in search of parameters that meet the model's constraints


class PointSource:
    """Draws values of a model's free parameters that meet its constraints, and unknown starts."""

    def __init__(self, model: ProcessModel, rng: np.random.Generator) -> None:
        self._model, self._rng = model, rng

    def nearby(self) -> FloatArray:
        """Parameters about their nominal values, none of which is special, (n_parameters,)."""
        return self._feasible(self._about)

    def anywhere(self) -> FloatArray:
        """Parameters anywhere in their ranges, (n_parameters,)."""
        return self._feasible(self._in_range)

    def start(self, state: State) -> float:
        """A start of a state that is unknown."""
        if state.initial_range is None or state.initial_range == AROUND_FIRST_SAMPLE:
            return float(self._rng.standard_normal())
        return float(self._rng.uniform(*state.initial_range))

    def _feasible(self, draw: Callable[[Parameter], float]) -> FloatArray:
        point = self._model.nominal
        for _ in range(_FEASIBLE):
            point = np.array([p.nominal if p.fixed else draw(p) for p in self._model.parameters])
            if all(c.function(tuple(point.tolist())) <= 0.0 for c in self._model.constraints):
                break
        return point

    def _about(self, parameter: Parameter) -> float:
        if parameter.nominal == 0.0:
            return self._in_range(parameter)
        value = parameter.nominal * math.exp(self._rng.uniform(-_NEAR, _NEAR))
        return min(max(value, parameter.minimum), parameter.maximum)

    def _in_range(self, parameter: Parameter) -> float:
        lower, upper = parameter.lower, parameter.upper
        if parameter.scale == "log":
            return float(math.exp(self._rng.uniform(math.log(lower), math.log(upper))))
        return float(self._rng.uniform(lower, upper))
