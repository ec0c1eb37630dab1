"""Measured inputs on which a state reacts, between their samples.

What a sensor measures of a torque behind which an inertia J turns is s - J domega/dt, with s as
smooth as the load. Commands step at the samples, and what follows happens between them: a straight
line has another mean there than the torque, by

    -J (mean of domega/dt - mean of its values at both samples)

which a free run tells, whose error is that of its parameters in parts of a small share.
"""

from dataclasses import replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.stepper import Stepper
from sysid.engine.trace import rates_along
from sysid.problem.data import Dataset
from sysid.problem.model import ProcessModel


def with_reactions(
    model: ProcessModel, record: Dataset, parameters: FloatArray, start: FloatArray
) -> Dataset:
    """The record with means ``between`` samples of inputs that have a reaction.

    parameters: (n_parameters,); start: (n_states,), of a free run. Nothing is bent where it is not
    finite.
    """
    reacting = [j for j, signal in enumerate(model.inputs) if signal.reaction]
    if not reacting:
        return record
    stepper, end = Stepper(model, parameters, record.dt), start.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        trace, _ = stepper.advance(end, record.inputs)
        states = np.vstack([trace[:: stepper.n_steps], end])
        rates = rates_along(model.derivative, states, record.inputs, parameters)
        bends = np.diff(states, axis=0) / record.dt - 0.5 * (rates[1:] + rates[:-1])
    between = np.zeros_like(record.inputs)
    for j in reacting:
        state, inertia = model.inputs[j].reaction or ("", 0.0)
        between[:-1, j] = -inertia * bends[:, model.state_names.index(state)]
    return replace(record, between=np.nan_to_num(between, nan=0.0, posinf=0.0, neginf=0.0))
