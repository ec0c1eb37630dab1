"""Exact Jacobians of any process model, operating points, and linear models at them."""

import functools
from typing import NamedTuple

import numpy as np

from sysid.arrays import FloatArray
from sysid.engine.gradient import Gradient
from sysid.problem.model import Function, ModelError, ProcessModel

# How far beside the guess an equilibrium is looked for in turn, in the states' own units.
_NUDGES = (0.0, 0.1, -0.1, 1.0, -1.0)


class LinearModel(NamedTuple):
    """dx/dt = A x + B u, y = C x + D u for small deviations from an operating point.

    A: (n_states, n_states), B: (n_states, n_inputs), C: (n_outputs, n_states),
    D: (n_outputs, n_inputs). Unpacks to (A, B, C, D).

    >>> A, B, C, D = LinearModel(-np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1)))
    >>> (-C @ np.linalg.inv(A) @ B + D).item()  # gain at rest
    1.0
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def linearize(
    model: ProcessModel, x: FloatArray, u: FloatArray, p: FloatArray | None = None
) -> LinearModel:
    """Jacobians of derivative and output at a point, by forward-mode differentiation.

    x: (n_states,), u: (n_inputs,), p: (n_parameters,), default nominal. They are exact to
    rounding wherever the model is differentiable; at a kink (|x| at zero) the slope of |x| is
    taken as 0. The result's four matrices are what ``control.ss`` takes. Raises ModelError for
    wrong shapes or a function that has no known derivative.

    >>> from sysid.examples import lag
    >>> linear = linearize(lag(), np.zeros(1), np.zeros(1))
    >>> linear.A.item(), linear.B.item(), linear.C.item(), linear.D.item()
    (-20.0, 40.0, 1.0, 0.0)
    """
    x, u, p = _point(model, x, u, p)
    n, m = len(x), len(u)
    slopes = _at(model, _gradient(model.derivative, n, m), x, u, p)
    if model.output is not None:
        outputs = _at(model, _gradient(model.output, n, m), x, u, p)
    else:
        assert model.output_states is not None
        outputs = np.eye(n + m)[list(model.output_states)]
    return LinearModel(slopes[:, :n], slopes[:, n:], outputs[:, :n], outputs[:, n:])


def jacobian(
    model: ProcessModel, x: FloatArray, u: FloatArray, p: FloatArray | None = None
) -> FloatArray:
    """df/dx at a point, (n_states, n_states); see ``linearize``.

    >>> from sysid import Output, Parameter, State
    >>> cooling = ProcessModel(
    ...     "cooling", [State("T", "K")], [], [Output("T", "K")],
    ...     [Parameter("k", "1/(K^3*s)", 2e-9, 1e-9, 1e-8)], lambda x, u, p: (-p[0] * x[0] ** 4,)
    ... )
    >>> jacobian(cooling, np.array([300.0]), np.zeros(0)).round(3).tolist()
    [[-0.216]]
    """
    x, u, p = _point(model, x, u, p)
    return _at(model, _gradient(model.derivative, len(x), len(u)), x, u, p)[:, : len(x)]


def linear_models(model: ProcessModel, x: FloatArray, u: FloatArray, p: FloatArray) -> LinearModel:
    """The matrices of ``linearize`` at one point under each of several parameter vectors.

    p: (m, n_parameters). Each (m, ...): all at once, unless the equations branch on what differs
    between them. NaN where there is no slope, as of a root at zero.
    """
    n, m = len(x), len(u)
    slopes = _under_each(model, model.derivative, n, x, u, p)
    if model.output is not None:
        outputs = _under_each(model, model.output, len(model.outputs), x, u, p)
    else:
        assert model.output_states is not None
        outputs = np.repeat(np.eye(n + m)[None, list(model.output_states)], len(p), axis=0)
    return LinearModel(slopes[..., :n], slopes[..., n:], outputs[..., :n], outputs[..., n:])


def _under_each(
    model: ProcessModel,
    function: Function,
    values: int,
    x: FloatArray,
    u: FloatArray,
    p: FloatArray,
) -> FloatArray:
    """Derivatives of one of the model's functions under parameter vectors, (m, values, n)."""
    gradient = _gradient(function, len(x), len(u))
    columns = [float(c[0]) if np.all(c == c[0]) else c for c in p.T]
    try:
        with np.errstate(all="ignore"):
            slopes = gradient.at(x.tolist(), u.tolist(), columns, (len(p),))
    except ArithmeticError:
        return np.full((len(p), values, len(x) + len(u)), np.nan)
    except (TypeError, ValueError):
        return np.stack([_at(model, gradient, x, u, row) for row in p])
    return np.ascontiguousarray(np.moveaxis(slopes, 2, 0))


def equilibrium(
    model: ProcessModel,
    u: FloatArray,
    p: FloatArray | None = None,
    *,
    guess: FloatArray | None = None,
    hold: dict[str, float] | None = None,
) -> FloatArray:
    """A state at which dx/dt is zero under constant inputs, (n_states,).

    hold: {state: value}, states kept at a value instead of solved for: an angle at a speed, or
    a speed whose driving torque is asked for; the derivative of a held state need not vanish.
    guess: where to start, default the declared initial state. Raises ModelError when none is
    found, with the largest remaining derivative.

    >>> from sysid import Input, Output, Parameter, State
    >>> tank = ProcessModel(
    ...     "tank", [State("level", "m", 1.0)], [Input("flow", "m/s")], [Output("level", "m")],
    ...     [Parameter("a", "m^0.5/s", 2.0, 0.1, 10.0)],
    ...     lambda x, u, p: (u[0] - p[0] * max(x[0], 0.0) ** 0.5,),
    ... )
    >>> equilibrium(tank, np.array([1.0])).round(6).tolist()
    [0.25]
    """
    from scipy.optimize import least_squares

    start = model.initial_state if guess is None else np.array(guess, dtype=np.float64)
    x, u, p = _point(model, start, u, p)
    for name, value in (hold or {}).items():
        if name not in model.state_names:
            raise ModelError(f"model {model.name} has no state {name!r} to hold")
        x[model.state_names.index(name)] = value
    free = [i for i, name in enumerate(model.state_names) if name not in (hold or {})]
    inputs, parameters = tuple(u.tolist()), tuple(p.tolist())

    def complete(values: FloatArray) -> FloatArray:
        whole = x.copy()
        whole[free] = values
        return whole

    def slopes(values: FloatArray) -> FloatArray:
        at = tuple(complete(values).tolist())
        return np.array(model.derivative(at, inputs, parameters))[free]

    def slopes_jacobian(values: FloatArray) -> FloatArray:
        return jacobian(model, complete(values), u, p)[np.ix_(free, free)]

    def solve(nudge: float) -> tuple[FloatArray, FloatArray]:
        """A stationary point of the search, and its derivatives in parts of their terms."""
        fit = least_squares(
            slopes, x[free] + nudge, jac=slopes_jacobian, x_scale="jac",
            xtol=1e-15, ftol=1e-15, gtol=1e-15,
        )  # fmt: skip
        terms = np.abs(slopes_jacobian(fit.x)) @ np.maximum(np.abs(fit.x), 1e-6)
        return fit.x, np.abs(fit.fun) / np.maximum(terms, 1e-12)

    # A start at which an equation has no slope is no help: then from beside it.
    for nudge in _NUDGES:
        solution, remaining = solve(nudge)
        if np.all(remaining < 1e-6):
            return complete(solution)
    worst = int(np.argmax(remaining))
    raise ModelError(
        f"model {model.name}: no equilibrium found; d{model.state_names[free[worst]]}/dt "
        f"stays at {slopes(solution)[worst]:.3g}. Give a guess, or hold a state that drifts"
    )


def _at(
    model: ProcessModel, gradient: Gradient, x: FloatArray, u: FloatArray, p: FloatArray
) -> FloatArray:
    """Derivatives of one of the model's functions at a point; ModelError where none is known."""
    try:
        return gradient.at(x.tolist(), u.tolist(), p.tolist())
    except TypeError as error:
        raise ModelError(f"model {model.name} cannot be differentiated: {error}") from None


_gradient = functools.lru_cache(maxsize=16)(Gradient)


def _point(
    model: ProcessModel, x: FloatArray, u: FloatArray, p: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    p = model.nominal if p is None else np.asarray(p, dtype=np.float64)
    x, u = np.array(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
    for what, values in (("states", x), ("inputs", u), ("parameters", p)):
        expected = len(getattr(model, what))
        if values.shape != (expected,):
            raise ModelError(
                f"model {model.name} has {expected} {what}; shape {values.shape} was given"
            )
    return x, u, p
