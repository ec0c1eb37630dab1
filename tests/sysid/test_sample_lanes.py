"""Lanes of one model, advanced sample by sample with inputs of their own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.engine.compiler import sample_lanes
from sysid.engine.scheme import LANES, work_area

MODEL = ProcessModel(
    "hardening spring",
    (State("x", "m", 0.1), State("v", "m/s"), State("force", "N")),
    (Input("command", "N"), Input("wall", "m", "foh")),
    (Output("x", "m"),),
    (Parameter("k", "N/m", 40.0, 10.0, 90.0), Parameter("rate", "1/s", 300.0, 100.0, 900.0)),
    lambda x, u, p: (
        x[1],
        x[2] - p[0] * (x[0] - u[1]) - 50.0 * (x[0] - u[1]) ** 3 - 0.5 * x[1],
        p[1] * (min(max(u[0], -2.0), 2.0) - x[2]),
    ),
)
TIME, SAMPLES, STEPS = 0.01, 12, 4


def test_each_lane_has_its_parameters_and_inputs():
    rng = np.random.default_rng(0)
    parameters = np.array([[40.0], [300.0]]) * rng.uniform(0.5, 2.0, (2, LANES))
    commands = rng.uniform(-3.0, 3.0, (SAMPLES, LANES))
    walls = np.cumsum(rng.uniform(-0.1, 0.1, (SAMPLES + 1, LANES)), axis=0)
    lanes = sample_lanes(MODEL)
    kernel = lanes.kernel
    work, inputs = work_area(kernel.work_rows * LANES), work_area(kernel.input_rows * LANES)
    states, rows = work.reshape(-1, LANES)[:3], inputs.reshape(-1, LANES)
    start = np.tile(MODEL.initial_state[:, None], LANES)
    step = TIME / STEPS
    lanes.prepare(work, work.reshape(-1, LANES), kernel.tables, start, parameters, step)
    for k in range(SAMPLES):
        rows[:] = commands[k], walls[k], walls[k + 1] - walls[k]
        lanes.advance(work, inputs, step, STEPS)
    for lane in (0, 7, LANES - 1):
        p, x = parameters[:, lane], MODEL.initial_state
        for k in range(SAMPLES):
            x = over_a_sample(x, p, commands[k, lane], walls[k : k + 2, lane])
        assert states[:, lane] == pytest.approx(x, rel=1e-5, abs=1e-6)


def over_a_sample(x, p, command, wall):
    def slopes(t, state):
        return MODEL.derivative(state, (command, wall[0] + (wall[1] - wall[0]) * t / TIME), p)

    return solve_ivp(slopes, (0.0, TIME), x, rtol=1e-9, atol=1e-12).y[:, -1]
