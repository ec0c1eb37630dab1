"""A first-order lag and a record of it, to try things on."""

from typing import Any

import numpy as np

from sysid.problem.data import Dataset
from sysid.problem.model import Input, Output, Parameter, ProcessModel, State


def lag() -> ProcessModel:
    """The lag tau dy/dt = gain u - y, gain 2 and tau 50 ms unless identified otherwise.

    >>> lag().parameter_names
    ('gain', 'tau')
    """
    return ProcessModel(
        name="lag",
        states=(State("y", "m"),),
        inputs=(Input("u", "V"),),
        outputs=(Output("y", "m"),),
        parameters=(
            Parameter("gain", "m/V", 2.0, 0.2, 20.0, "log"),
            Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
        ),
        derivative=_derivative,
    )


def lag_record(gain: float = 3.0, tau: float = 0.04, seed: int = 0) -> Dataset:
    """Two seconds of a lag at 100 Hz under random levels of 80 ms, with 1 % of white noise.

    >>> lag_record().outputs.shape
    (200, 1)
    """
    rng = np.random.default_rng(seed)
    n, dt = 200, 0.01
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 8), 8)
    y = np.zeros(n)
    for k in range(n - 1):
        y[k + 1] = gain * u[k] + (y[k] - gain * u[k]) * np.exp(-dt / tau)
    return Dataset(u, y + 0.01 * gain * rng.standard_normal(n), dt, f"lag {seed}")


def _derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
    gain, tau = p
    return ((gain * u[0] - x[0]) / tau,)
