"""Slow, trusted simulation by SciPy: the independent check of the batch kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
from sysid.response.linearization import jacobian
from tests.sysid.support import outputs_of

Method = Literal["DOP853", "RK45", "Radau", "BDF", "LSODA"]
_IMPLICIT = ("Radau", "BDF", "LSODA")


def simulate(
    model: ProcessModel,
    parameters: FloatArray,
    record: Dataset,
    *,
    method: Method = "DOP853",
    rtol: float = 1e-9,
    atol: float = 1e-12,
) -> FloatArray:
    """Free-run outputs, (n_samples, n_outputs), each sample interval solved on its own.

    The intervals are separate because held inputs jump between them. The implicit methods are
    given the exact Jacobian. Raises ModelError when SciPy gives up, naming the instant.
    """
    from scipy.integrate import solve_ivp

    solve: Any = solve_ivp  # its types know no option that depends on the method
    record.check(model)
    p = tuple(float(v) for v in parameters)
    x = record.initial_state(model)
    between = _between(model, record)
    outputs = np.empty((record.n_samples, len(model.outputs)))
    for k in range(record.n_samples):
        u0 = record.inputs[k]
        outputs[k] = outputs_of(model, tuple(x), tuple(u0), p)
        if k == record.n_samples - 1:
            break

        def rhs(t: float, state: FloatArray, k: int = k) -> FloatArray:
            return np.array(model.derivative(tuple(state), tuple(between(k, t)), p))

        def jac(t: float, state: FloatArray, k: int = k) -> FloatArray:
            return jacobian(model, state, between(k, t), parameters)

        solution = solve(
            rhs,
            (0.0, record.dt),
            x,
            method=method,
            rtol=rtol,
            atol=atol,
            **({"jac": jac} if method in _IMPLICIT else {}),
        )
        if not solution.success:
            raise ModelError(
                f"SciPy's {method} stopped at t = {k * record.dt:g} s: {solution.message}"
            )
        x = solution.y[:, -1]
    return outputs


def _between(model: ProcessModel, record: Dataset) -> Callable[[int, float], FloatArray]:
    """Inputs at a time after sample k, as each is declared to run between samples."""
    from scipy.interpolate import CubicSpline

    holds = np.array([signal.hold for signal in model.inputs])
    foh, splined = holds == "foh", holds == "spline"
    spline = CubicSpline(record.time, record.inputs) if splined.any() else None

    def between(k: int, t: float) -> FloatArray:
        slope = np.where(foh, record.inputs[k + 1] - record.inputs[k], 0.0) / record.dt
        u: FloatArray = record.inputs[k] + slope * t
        return u if spline is None else np.where(splined, spline(record.time[k] + t), u)

    return between
