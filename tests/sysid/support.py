"""Small models and records that the tests share."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np

from sysid import Constraint, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.engine.simulation import BatchResult, Residuals
from sysid.threads import Workers


def outputs_of(model, x, u, p):
    """Outputs at one point; arrays of equal shape may stand in place of floats."""
    if model.output is not None:
        return model.output(tuple(x), tuple(u), tuple(p))
    return tuple(x[i] for i in model.output_states)


def lag_derivative(x, u, p):
    return ((p[0] * u[0] - x[0]) / p[1],)


def lag(hold="zoh", **changes):
    settings = {
        "name": "lag",
        "states": (State("y", "1"),),
        "inputs": (Input("u", "1", hold),),
        "outputs": (Output("y", "1"),),
        "parameters": (
            Parameter("gain", "1", 2.0, 0.2, 20.0, "log"),
            Parameter("tau", "s", 0.05, 0.005, 0.5, "log"),
        ),
        "derivative": lag_derivative,
    }
    return ProcessModel(**(settings | changes))


def motor_derivative(x, u, p):
    current, omega = x
    resistance, inductance, inertia, damping, constant = p
    return (
        (u[0] - resistance * current - constant * omega) / inductance,
        (constant * current - damping * omega - u[1]) / inertia,
    )


MOTOR = {
    "resistance": 1.0,
    "inductance": 6e-4,
    "inertia": 8e-7,
    "damping": 1.33e-5,
    "constant": 2.38e-2,
}


def motor(factor=10.0, constraints=()):
    return ProcessModel(
        name="motor",
        states=(State("current", "A"), State("omega", "rad/s")),
        inputs=(Input("voltage", "V", "foh"), Input("load", "N*m", "foh")),
        outputs=(Output("current", "A"), Output("omega", "rad/s")),
        parameters=tuple(
            Parameter(name, "1", value, value / factor, value * factor, "log")
            for name, value in MOTOR.items()
        ),
        derivative=motor_derivative,
        constraints=constraints,
    )


def motor_inputs(n=200, dt=0.01, period=1.0, duty=0.5, frequency=0.3, amplitude=0.01):
    t = np.arange(n) * dt
    voltage = np.where(np.mod(t + 1e-9, period) < duty * period, 1.0, -1.0)
    return np.column_stack([voltage, amplitude * np.sin(2 * math.pi * frequency * t)])


def motor_matrices(p):
    resistance, inductance, inertia, damping, constant = p
    a = np.array(
        [
            [-resistance / inductance, -constant / inductance],
            [constant / inertia, -damping / inertia],
        ]
    )
    return a, np.array([[1.0 / inductance, 0.0], [0.0, -1.0 / inertia]])


def motor_record(n=200, dt=0.01, **how):
    """Noise-free response of the nominal motor, from the matrix exponential."""
    inputs = motor_inputs(n, dt, **how)
    outputs = linear_response(*motor_matrices(MOTOR.values()), inputs, dt, hold="foh")
    return Dataset(inputs, outputs, dt)


def linear_response(a, b, inputs, dt, hold, x0=None):
    """States of x' = Ax + Bu at the samples, exact for held or linearly interpolated inputs."""
    from scipy.linalg import expm

    n, m = b.shape
    # Augmented with the inputs and their slope, the system is autonomous.
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = a, b
    block[n : n + m, n + m :] = np.eye(m)
    step = expm(block * dt)[:n]
    x = np.zeros((len(inputs), n))
    if x0 is not None:
        x[0] = x0
    for k in range(len(inputs) - 1):
        slope = (inputs[k + 1] - inputs[k]) / dt if hold == "foh" else np.zeros(m)
        x[k + 1] = step @ np.concatenate([x[k], inputs[k], slope])
    return x


def blank(model, inputs, dt, **first):
    """A record with inputs alone; ``first`` gives outputs of the first row."""
    outputs = np.full((len(inputs), len(model.outputs)), np.nan)
    for name, value in first.items():
        outputs[0, model.output_names.index(name)] = value
    return Dataset(inputs, outputs, dt)


def pendulum_derivative(x, u, p):
    theta, omega = x
    inertia, viscous, weight = p
    return omega, (u[0] - viscous * omega - weight * math.sin(theta)) / inertia


def pendulum(theta=None, omega=None):
    """A driven pendulum; theta, omega: ranges of its start where that is estimated."""
    return ProcessModel(
        "pendulum",
        (State("theta", "rad", initial_range=theta), State("omega", "rad/s", initial_range=omega)),
        (Input("torque", "N*m", "zoh"),), (Output("theta", "rad"),),
        (
            Parameter("inertia", "kg*m^2", 0.01, 0.001, 0.1, "log"),
            Parameter("viscous", "N*m*s/rad", 0.01, 0.001, 0.1, "log"),
            Parameter("weight", "N*m", 0.5, 0.05, 5.0, "log"),
        ),
        pendulum_derivative,
    )  # fmt: skip


def draw(model, rng, n):
    """Parameter vectors drawn from the model's ranges, on each parameter's scale."""
    vectors = np.tile(model.nominal, (n, 1))
    for i, p in enumerate(model.parameters):
        if p.fixed:
            continue
        if p.scale == "log":
            vectors[:, i] = np.exp(rng.uniform(np.log(p.lower), np.log(p.upper), n))
        else:
            vectors[:, i] = rng.uniform(p.lower, p.upper, n)
    return vectors


def prbs(rng, n, low, high, hold=8):
    """Random levels, each held for a while."""
    return np.repeat(rng.uniform(low, high, -(-n // hold)), hold)[:n]


def held_lag(u, samples, gain, tau, parts=1):
    """Exact outputs of a lag from rest to what is held so many samples earlier.

    tau: in samples. Parts of samples apart, to the last sample of u.
    """
    n = len(u)
    grid = np.arange((n - 1) * parts + 1) / parts
    changes = np.arange(-n, 2 * n) - samples
    times = np.unique([*grid, *changes[(changes > 0.0) & (changes < n - 1.0)]])
    values = [0.0]
    for begin, end in itertools.pairwise(times):
        held = gain * u[np.clip(int(np.floor(0.5 * (begin + end) + samples)), 0, n - 1)]
        values.append(held + (values[-1] - held) * np.exp(-(end - begin) / tau))
    return np.array(values)[np.searchsorted(times, grid)]


def normalised_rms(simulated, exact):
    scale = np.max(np.abs(exact), axis=-2)
    scale = np.where(scale > 0.0, scale, 1.0)
    return np.sqrt(np.mean((simulated - exact) ** 2, axis=-2)) / scale


def never(p):
    """A constraint that nothing meets."""
    return 1.0 + 0.0 * p[0]


INFEASIBLE = Constraint("1 <= 0", never)


class Formula:
    """A simulator of outputs that are a formula of parameters and inputs.

    formula: (p, u) -> (n_samples, n_outputs), p a mapping of names to values.
    """

    accuracy = 1e-10

    def __init__(self, model, formula):
        self.model, self.formula, self.workers = model, formula, Workers(2)

    def steps_of_each(self, vectors, record):
        return np.ones(len(vectors), dtype=int)

    def steps_needed(self, vectors, records, starts):
        return np.stack([self.steps_of_each(vectors, record) for record in records], axis=1)

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        names = self.model.parameter_names
        return np.stack(
            [self.formula(dict(zip(names, v, strict=True)), record.inputs) for v in vectors]
        )

    def residuals(self, vectors, records, scales, n_steps, starts, *, keep=True):
        parts = []
        for record, scale, steps in zip(records, scales, n_steps.T, strict=True):
            found = (self.trajectories(vectors, record, steps) - record.outputs) / scale
            found[:, ~np.isfinite(record.outputs)] = 0.0
            parts.append(found)
        sse = np.stack([np.sum(part**2, axis=1) for part in parts], axis=1)
        needed = self.steps_needed(vectors, records, starts)
        values = np.moveaxis(np.concatenate(parts, axis=1), 0, 2).copy()
        return Residuals(values, sse, needed / n_steps)

    def tangents(self, vectors, records, directions, n_steps, starts, moves, scales):
        """As of BatchSimulator, by differences: formulas are smooth. Starts move nothing."""
        step, parts = 1e-6, []
        for record, scale in zip(records, scales, strict=True):
            ahead, behind = (
                np.stack([
                    self.trajectories(vectors + way * along, record)
                    for along in np.moveaxis(directions, 1, 0)
                ], axis=-1)
                for way in (step, -step)
            )  # fmt: skip
            slopes = (ahead - behind) / (2.0 * step) / np.reshape(scale, (-1, 1))
            parts.append(np.where(np.isfinite(record.outputs)[..., None], slopes, 0.0))
        return parts

    def errors(self, vectors, records, scales, starts):
        needed = self.steps_needed(vectors, records, starts)
        sse = self.residuals(vectors, records, scales, needed, starts).sse
        return BatchResult(sse, np.zeros(len(vectors), dtype=int), needed.sum(axis=1))


def scikit_learn_checks(estimators, **options):
    """``parametrize_with_checks`` of estimators that are none of scikit-learn's own classes."""
    from sklearn.utils.estimator_checks import parametrize_with_checks

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not inherit from")
        return parametrize_with_checks(estimators, **options)
