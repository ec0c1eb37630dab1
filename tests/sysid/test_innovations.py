"""Noise of measured inputs: the filter against plain filters, and the bias that is to vanish."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid import (
    GASSI,
    BatchSimulator,
    Dataset,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    State,
)
from tests.sysid.support import lag, linear_response, prbs

DT, TAU, GAIN = 0.02, 0.05, 2.0
OF_INPUT, OF_OUTPUT = 0.3, 0.2


def test_of_a_linear_system_innovations_are_those_of_a_kalman_filter():
    rng = np.random.default_rng(0)
    u, y = prbs(rng, 60, -1.0, 1.0), rng.standard_normal(60)
    y[[20, 21, 40]] = np.nan
    record = Dataset(u, y, DT, input_noise=np.array([OF_INPUT]))
    innovations = simulate(lag(), [GAIN, TAU], record, [OF_OUTPUT], steps=3)
    assert innovations[:, 0] == pytest.approx(kalman_filter(u, y), abs=1e-12)


def kalman_filter(u, y):
    """Innovations of the lag by the textbook: states are y and the noise of the present input."""
    a = np.exp(-DT / TAU)
    F, G = np.array([[a, GAIN * (1.0 - a)], [0.0, 0.0]]), np.array([0.0, 1.0])
    # It starts at the first sample, which has the output's noise and no innovation.
    x, P = np.array([y[0], 0.0]), np.diag([OF_OUTPUT**2, OF_INPUT**2])
    innovations = np.zeros(len(y))
    for k in range(1, len(y)):
        x = F @ (x + np.array([0.0, u[k - 1]]))
        P = F @ P @ F.T + OF_INPUT**2 * np.outer(G, G)
        if np.isfinite(y[k]):
            e, s = x[0] - y[k], P[0, 0] + OF_OUTPUT**2
            x, P = x - P[:, 0] / s * e, P - np.outer(P[:, 0], P[:, 0]) / s
            innovations[k] = e * OF_OUTPUT / np.sqrt(s)
    return innovations


def pendulum():
    def derivative(x, u, p):
        angle, speed = x
        return speed, p[0] * u[0] - p[1] * math.sin(angle) - p[2] * abs(speed) * speed + u[1]

    def output(x, u, p):
        return x[0] + 0.1 * x[0] ** 2, p[0] * u[0] + 0.5 * x[1]

    return ProcessModel(
        "pendulum",
        (State("angle", "rad"), State("speed", "rad/s")),
        (Input("torque", "N*m", "foh"), Input("push", "N*m", "zoh")),
        (Output("lean", "rad"), Output("force", "N*m")),
        tuple(Parameter(name, "1", 1.0, 0.1, 10.0) for name in ("b", "g", "c")),
        derivative,
        output,
    )


def test_of_a_nonlinear_system_they_are_those_of_an_extended_kalman_filter():
    rng, model, dt = np.random.default_rng(1), pendulum(), 0.1
    p, noise = np.array([2.0, 9.0, 0.4]), np.array([0.05, 0.3])
    of_inputs = np.array([0.4, 0.2])
    u = np.column_stack([prbs(rng, 40, -3.0, 3.0), prbs(rng, 40, -1.0, 1.0)])
    y = np.column_stack([0.6 * np.sin(np.arange(40) / 3.0), prbs(rng, 40, -3.0, 3.0, hold=3)])
    record = Dataset(u, y, dt, input_noise=of_inputs)
    innovations = simulate(model, p, record, noise, steps=60)
    expected = extended_kalman_filter(model, p, record, noise)
    assert innovations == pytest.approx(expected, abs=3e-5)
    assert np.std(expected) > 0.1


def extended_kalman_filter(model, p, record, noise):
    """Plain and slow: integrated by SciPy, Jacobians by central differences of what it gives."""
    dt, n, m = record.dt, len(model.states), len(model.inputs)

    def flow(z, k, after):
        """States after an interval, of states and the noise of the inputs at its ends."""

        def rate(t, x):
            held, moved = record.inputs[k] + z[n:], record.inputs[k + 1] + after
            u = (held[0] + (moved[0] - held[0]) * t / dt, held[1])
            return model.derivative(tuple(x), u, tuple(p))

        return solve_ivp(rate, (0.0, dt), z[:n], rtol=1e-10, atol=1e-12).y[:, -1]

    def outputs(z, k):
        return np.array(model.output(tuple(z[:n]), tuple(record.inputs[k] + z[n:]), tuple(p)))

    def slopes(function, at):
        h = 1e-5
        columns = [function(at + h * e) - function(at - h * e) for e in np.eye(len(at))]
        return np.stack(columns, axis=1) / (2.0 * h)

    variances, none = np.diag(record.input_noise**2), np.zeros(m)
    z, P = np.zeros(n + m), np.zeros((n + m, n + m))
    P[n:, n:] = variances
    innovations = np.zeros_like(record.outputs)
    for k in range(record.n_samples):
        g, C, before = outputs(z, k), slopes(lambda z, k=k: outputs(z, k), z), z.copy()
        for j in range(len(g)):
            e = g[j] + C[j] @ (z - before) - record.outputs[k, j]
            s = C[j] @ P @ C[j] + noise[j] ** 2
            innovations[k, j] = e * noise[j] / np.sqrt(s)
            z, P = z - P @ C[j] / s * e, P - np.outer(P @ C[j], P @ C[j]) / s
        if k == record.n_samples - 1:
            return innovations
        at, estimate = np.concatenate([z[:n], none]), z[n:]
        F = slopes(lambda z, k=k: flow(z, k, none), at)
        G = slopes(lambda after, k=k, at=at: flow(at, k, after), none)
        z = np.concatenate([flow(at, k, none) + F[:, n:] @ estimate, none])
        states = F @ P @ F.T + G @ variances @ G.T
        P = np.block([[states, G @ variances], [variances @ G.T, variances]])
    return innovations


def simulate(model, p, record, noise, steps):
    """Innovations (n_samples, n_outputs) at unit scale."""
    q = len(model.outputs)
    simulated = BatchSimulator(model).innovations(
        np.array([p]), [record], [np.ones(q)], np.array([[steps]]), [None], np.array(noise)
    )
    return simulated.values[..., 0]


def noisy_records(pairs, of_input=0.5, of_output=0.1):
    """Records of a lag whose noise comes in pairs of opposite sign: only biases are left."""
    for pair in range(pairs):
        rng = np.random.default_rng(pair)
        u = prbs(rng, 400, -1.0, 1.0, hold=16)
        a, b = np.array([[-1.0 / TAU]]), np.array([[GAIN / TAU]])
        y = linear_response(a, b, u[:, None], DT, "zoh")
        error, v = rng.standard_normal((400, 1)), rng.standard_normal((400, 1))
        v[0] = 0.0
        for sign in (1.0, -1.0):
            yield Dataset(
                u[:, None] + sign * of_input * error,
                y + sign * of_output * v,
                DT,
                input_noise=np.array([of_input]),
            )


def mean_error(criterion, records):
    """Mean deviation of the lag's logarithms of gain and time constant."""
    errors = []
    for record in records:
        fit = GASSI(lag(), population=20, generations=8, criterion=criterion).fit(record)
        errors.append(np.log(np.array(list(fit.parameters_.values())) / [GAIN, TAU]))
    return np.mean(errors, axis=0)


def test_the_bias_that_noise_of_an_input_brings_is_taken_away():
    records = list(noisy_records(4))
    free_run = mean_error("likelihood", records)
    assert free_run[0] < -0.05  # the gain, as by regression on a noisy input
    for criterion in ("compensated", "innovations"):
        bias = mean_error(criterion, records)
        assert np.all(np.abs(bias) < 0.5 * np.abs(free_run))


def test_a_noisy_input_chooses_the_criterion():
    (record, _) = noisy_records(1)
    fit = GASSI(lag(), population=20, generations=2).fit(record)
    assert fit.criterion_ == "compensated"
    assert "u is measured with noise" in fit.criterion_reason_
    timed = replace(record, windows=np.zeros((*record.outputs.shape, 2)))
    assert GASSI(lag(), population=20, generations=2).fit(timed).criterion_ == "innovations"


def test_where_noise_explains_all_of_a_free_run_a_filter_takes_over():
    *_, record = list(noisy_records(2, of_output=0.01))[:3]
    fit = GASSI(lag(), population=20, generations=8).fit(record)
    assert fit.criterion_ == "innovations"
    assert "explain more than all of the free run's error" in fit.criterion_reason_
    assert fit.parameters_["gain"] == pytest.approx(GAIN, rel=0.01)
    estimates = fit.uncertainty(record).parameters
    assert all(e.low < truth < e.high for e, truth in zip(estimates, (GAIN, TAU), strict=True))


@pytest.mark.parametrize("criterion", ["compensated", "innovations"])
def test_intervals_hold_the_truth(criterion):
    held = []
    for record in noisy_records(5, of_input=0.2):
        fit = GASSI(lag(), population=20, generations=8, criterion=criterion).fit(record)
        estimates = zip(fit.uncertainty(record).parameters, (GAIN, TAU), strict=True)
        held += [e.low < truth < e.high for e, truth in estimates]
    assert sum(held) >= 17  # of 20


def test_without_noise_of_inputs_there_is_nothing_to_filter():
    (record, _) = noisy_records(1)
    exact = Dataset(record.inputs, record.outputs, DT, "exact")
    assert GASSI(lag(), population=20, generations=2).fit(exact).criterion_ == "likelihood"
    with pytest.raises(ModelError, match="criterion innovations needs the noise of a measured"):
        GASSI(lag(), criterion="innovations").fit(exact)


def test_equations_that_branch_are_fitted_as_before_and_refused_where_asked_for():
    def derivative(x, u, p):
        return ((p[0] * u[0] - x[0]) / p[1] if u[0] > -9.0 else 0.0,)

    (record, _) = noisy_records(1)
    model = lag(derivative=derivative)
    fit = GASSI(model, population=20, generations=2).fit(record)
    assert fit.criterion_ == "likelihood"
    assert "cannot be differentiated" in fit.criterion_reason_
    with pytest.raises(ModelError, match="write conditions with abs, min, max"):
        GASSI(model, criterion="innovations").fit(record)
