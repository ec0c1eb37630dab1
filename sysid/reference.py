"""Slow, trusted simulation by SciPy: the independent check of the batch kernels."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from sysid.data import Dataset
from sysid.linearization import jacobian
from sysid.model import FloatArray, ModelError, ProcessModel

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
    foh = np.array([signal.hold == "foh" for signal in model.inputs], dtype=bool)
    outputs = np.empty((record.n_samples, len(model.outputs)))
    for k in range(record.n_samples):
        u0 = record.inputs[k]
        outputs[k] = model.evaluate_output(tuple(x), tuple(u0), p)
        if k == record.n_samples - 1:
            break
        slope = np.where(foh, record.inputs[k + 1] - u0, 0.0) / record.dt

        def rhs(
            t: float, state: FloatArray, u0: FloatArray = u0, slope: FloatArray = slope
        ) -> FloatArray:
            u = u0 + slope * t
            return np.array(model.derivative(tuple(state), tuple(u), p))

        def jac(
            t: float, state: FloatArray, u0: FloatArray = u0, slope: FloatArray = slope
        ) -> FloatArray:
            return jacobian(model, state, u0 + slope * t, parameters)

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
