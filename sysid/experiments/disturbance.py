"""A model whose inputs are disturbed, by as much as further parameters say."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sysid.problem.model import Function, Input, Parameter, ProcessModel


def with_disturbances(model: ProcessModel, places: Sequence[int], count: int) -> ProcessModel:
    """Further inputs, so many for each of some inputs by their places, that are added to these.

    Each times a further parameter, by its number, that is zero: the outputs' slopes by it are what
    the disturbance of that number does to them.
    """
    names = [model.inputs[j].name for j in places]
    channels = [
        Input(f"{name} {k}", model.inputs[j].unit, model.inputs[j].hold)
        for j, name in zip(places, names, strict=True)
        for k in range(count)
    ]
    sizes = [
        Parameter(f"disturbance {k}", "1", 0.0, -1.0, 1.0, fixed=True, minimum=-1.0)
        for k in range(count)
    ]
    n_inputs, n_parameters = len(model.inputs), len(model.parameters)

    def disturbed(function: Function) -> Function:
        def call(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            inputs = list(u[:n_inputs])
            for i, j in enumerate(places):
                first = n_inputs + count * i
                for k in range(count):
                    inputs[j] = inputs[j] + p[n_parameters + k] * u[first + k]
            return function(x, tuple(inputs), p[:n_parameters])

        return call

    return replace(
        model,
        inputs=(*model.inputs, *channels),
        parameters=(*model.parameters, *sizes),
        derivative=disturbed(model.derivative),
        output=model.output and disturbed(model.output),
        constraints=(),
    )
