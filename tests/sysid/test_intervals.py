"""Jacobians of the intervals between samples, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.engine.intervals import Intervals, IntervalSlopes
from sysid.examples import lag

DT, GAIN, TAU, SAMPLES = 0.02, 2.0, 0.05, 40  # more than one block of lanes
DECAY = np.exp(-DT / TAU)


def slopes(model, inputs, vector=(GAIN, TAU), start=0.3):
    intervals = Intervals(model, np.array(vector), inputs, DT, 4)
    return IntervalSlopes(intervals, intervals.run(np.array([start])))


def inputs():
    return np.random.default_rng(0).standard_normal((SAMPLES, 1))


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_slopes_of_a_lag_are_those_of_its_solution(hold):
    signal = inputs()
    lagging = slopes(lag().with_holds({"u": hold}), signal)
    at_begin, at_end = lagging.by_input(0)
    # Of the response to a straight line from zero to one the end's part is the mean of the rest.
    end = 1.0 - TAU / DT * (1.0 - DECAY) if hold == "foh" else 0.0
    np.testing.assert_allclose(lagging.by_states[:, 0], DECAY, rtol=1e-7)
    np.testing.assert_allclose(at_end, GAIN * end, rtol=1e-7)
    np.testing.assert_allclose(at_begin + at_end, GAIN * (1.0 - DECAY), rtol=1e-7)
    rate_begin, rate_end = lagging.by_causes[:, 1], lagging.by_causes[:, -1]
    np.testing.assert_allclose(rate_begin + rate_end, TAU * (1.0 - DECAY), rtol=1e-7)
    by_gain = lagging.by_parameters[:, 0]
    constant = signal[:-1] * (1.0 - DECAY - end) + signal[1:] * end
    np.testing.assert_allclose(by_gain, constant, atol=1e-8)


def switched(x, u, p):
    """A relay on the state, which a trace cannot follow without a point."""
    return ((p[0] * u[0] - x[0]) / p[1] - (5.0 if x[0] > 0.0 else 0.0),)


def test_where_a_state_switches_no_slope_is_endless():
    """It rests where more of it switches, until something drives it."""
    relay, signal = replace(lag(), name="relay", derivative=switched), -np.abs(inputs())
    signal[:5] = 0.0
    np.testing.assert_allclose(slopes(relay, signal, start=0.0).by_states, DECAY, rtol=1e-6)


def test_on_a_kink_a_slope_is_the_mean_of_its_sides():
    """A state at rest that only |x| drives."""
    kinked = replace(lag(), name="kinked", derivative=lambda x, u, p: (p[0] * abs(x[0]) / p[1],))
    at_rest = slopes(kinked, np.zeros((SAMPLES, 1)), start=0.0).by_states
    growth = GAIN * DT / TAU
    np.testing.assert_allclose(at_rest, 0.5 * (np.exp(growth) + np.exp(-growth)), rtol=1e-4)
