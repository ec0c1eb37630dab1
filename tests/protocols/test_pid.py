"""The PID controller, its ramp and its estimate of speed against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from protocols.control.loop import Pid, Ramp, SpeedTracker, VelocityGains

STEP = 1.0 / 800.0  # s
numbers = st.floats(-100.0, 100.0)


def pid(p=0.0, i=0.0, d=0.0, filter_time=0.0, limit=1e9):
    gains = VelocityGains(proportional=p, integral=i, derivative=d, derivative_filter=filter_time)
    return Pid(gains, -limit, limit)


def outputs(controller, references, measured, step=STEP):
    steps = enumerate(np.broadcast(references, measured))
    return np.array([controller.output(k * step, *pair) for k, pair in steps])


@pytest.mark.parametrize("filter_time", [0.0, 0.004, 0.1])
def test_the_derivative_is_the_filtered_backward_difference(filter_time):
    measured = np.random.default_rng(1).standard_normal(200)
    got = outputs(pid(d=0.3, filter_time=filter_time), 0.0, measured)
    # -K_d s / (T_f s + 1) with s = (1 - z^-1) / h, from rest at the first measurement.
    b, a = [1.0, -1.0], [filter_time + STEP, -filter_time]
    np.testing.assert_allclose(got, -0.3 * lfilter(b, a, measured - measured[0]), atol=1e-9)


def test_the_derivative_of_a_ramp_ends_at_its_slope_and_ignores_the_reference():
    ramp = 5.0 * STEP * np.arange(400)
    got = outputs(pid(d=0.2, filter_time=0.01), np.where(np.arange(400) < 300, 0.0, 9.0), ramp)
    expected = -0.2 * 5.0 * (1.0 - (0.01 / (0.01 + STEP)) ** np.arange(400))
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_the_integral_of_a_constant_error_rises_in_a_line():
    got = outputs(pid(p=2.0, i=30.0), 0.5, np.zeros(100))
    np.testing.assert_allclose(got, 30.0 * 0.5 * STEP * np.arange(100), atol=1e-12)


def test_a_lost_sample_is_made_up_for():
    every, some = pid(i=10.0), pid(i=10.0)
    for k in range(20):
        last = every.output(k * STEP, 1.0, 0.0)
    for k in (0, 1, 5, 19):
        after_loss = some.output(k * STEP, 1.0, 0.0)
    assert after_loss == pytest.approx(last)


@given(reference=numbers, measured=numbers, p=st.floats(0, 10))
def test_it_starts_without_a_bump(reference, measured, p):
    controller = pid(p=p, i=1.0, limit=5.0)
    assert controller.output(0.0, reference, measured) == pytest.approx(0.0, abs=1e-9)


def test_without_an_integral_the_first_output_is_proportional():
    assert pid(p=2.0).output(0.0, 1.5, 1.0) == 1.0


@given(
    st.lists(st.tuples(numbers, numbers), min_size=1, max_size=50),
    st.floats(0, 10), st.floats(0, 1000), st.floats(0, 0.1),
)  # fmt: skip
def test_the_output_never_passes_its_limits(rows, p, i, d):
    controller = pid(p, i, d, 0.01, limit=4.5)
    for k, (reference, measured) in enumerate(rows):
        assert abs(controller.output(k * STEP, reference, measured)) <= 4.5


def test_the_output_leaves_its_limit_in_the_sample_in_which_the_error_turns():
    # Ten seconds at the limit would wind a plain integral up to 5000 V.
    controller = pid(p=0.1, i=50.0, limit=4.0)
    stuck = outputs(controller, 10.0, np.zeros(8000))
    assert stuck[-1] == 4.0
    assert controller.output(8000 * STEP, 10.0, 10.5) < 4.0


def test_at_its_limit_the_integral_is_what_it_was_when_the_limit_was_reached():
    controller = pid(p=0.1, i=1.0, limit=2.0)
    outputs(controller, 10.0, np.zeros(5000))  # e = 10: the proportional part is 1 V
    # So the integral stopped at the other volt.
    assert controller.output(5000 * STEP, 0.0, 0.0) == pytest.approx(1.0, abs=1e-9)


def test_an_integral_at_the_limit_gives_way_to_an_error_that_leads_back():
    controller = pid(i=100.0, limit=1.0)
    outputs(controller, 1.0, np.zeros(100))
    got = [controller.output((100 + k) * STEP, -1.0, 0.0) for k in range(3)]
    np.testing.assert_allclose(np.diff(got), -100.0 * STEP)


def closed_loop(controller, reference, seconds, disturbance):
    """A first-order lag, 0.05 s and 10 per volt, exactly between samples; its outputs."""
    decay = np.exp(-STEP / 0.05)
    y, trace = 0.0, []
    for k in range(round(seconds / STEP)):
        trace.append(y)
        u = controller.output(k * STEP, reference, y)
        y = decay * y + (1.0 - decay) * 10.0 * (u + disturbance)
    return np.array(trace)


def test_a_loop_with_an_integral_ends_at_its_reference():
    trace = closed_loop(pid(p=0.2, i=4.0), 20.0, 2.0, disturbance=-0.7)
    np.testing.assert_allclose(trace[-10:], 20.0, atol=1e-6)


def test_a_saturated_loop_overshoots_no_more_than_a_free_one():
    # 2.1 V hold the reference; the limit of 2.3 V makes the approach long.
    trace = closed_loop(pid(p=0.2, i=4.0, limit=2.3), 20.0, 2.0, disturbance=-0.1)
    free = closed_loop(pid(p=0.2, i=4.0), 20.0, 2.0, disturbance=-0.1)
    assert trace.max() < free.max() + 0.02
    np.testing.assert_allclose(trace[-10:], 20.0, atol=1e-6)


def test_the_ramp_rises_by_its_slope_and_stays_at_its_target():
    ramp = Ramp(slope=100.0, value=-1.0)
    values = [ramp.towards(3.0, 0.01) for _ in range(6)]
    assert values == pytest.approx([0.0, 1.0, 2.0, 3.0, 3.0, 3.0])
    assert ramp.towards(2.5, 1.0) == 2.5


@pytest.mark.parametrize("bandwidth", [10.0, 60.0])
def test_the_tracker_has_no_error_at_constant_speed(bandwidth):
    tracker = SpeedTracker(bandwidth)
    for k in range(800):
        speed = tracker.update(k * STEP, 0.3 + 25.0 * k * STEP)
    assert speed == pytest.approx(25.0, abs=1e-6)


def test_the_tracker_answers_a_step_of_speed_as_a_critically_damped_filter():
    tracker, w = SpeedTracker(20.0), 2.0 * np.pi * 20.0
    times = np.arange(400) * 1e-4
    got = np.array([tracker.update(t, 8.0 * t) for t in times])
    np.testing.assert_allclose(got, 8.0 * (1.0 - (1.0 + w * times) * np.exp(-w * times)), atol=0.06)


def test_the_tracker_smooths_a_coarse_encoder():
    counts = 2.0 * np.pi / 8192
    tracker, speeds = SpeedTracker(20.0), []
    for k in range(4000):
        speeds.append(tracker.update(k * STEP, np.floor(1.37 * k * STEP / counts) * counts))
    settled = np.array(speeds[800:])
    differences = counts / STEP  # 0.61 rad/s: what a plain difference of counts resolves
    assert settled.std() < differences / 20
    assert settled.mean() == pytest.approx(1.37, abs=1e-3)
