"""What an encoder's speeds are the means of, against motions whose angle is known at any time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from daq.identification.records import from_recording
from daq.logs.encoder import mean_speeds
from daq.logs.recording import load
from daq.lookup.experiments import load_experiment
from daq.lookup.rigs import load_rig
from daq.run.runner import run_experiment
from sim_rig.actuator import actuator
from sim_rig.backend import SimulatedDevice
from sysid import Dataset
from sysid.fitting.means import scatter

COUNT = 2.0 * math.pi / 8192  # rad
DT = 1.0 / 800.0  # s
FINE = 1000  # points of a sample


def passed(angle, n):
    """Counts at n + 1 ticks, times and directions of edges, and which was the last up to each."""
    t = np.arange(n * FINE + 1) * (DT / FINE)
    counts = np.floor(angle(t) / COUNT)
    places = np.flatnonzero(np.diff(counts)) + 1
    # By places, not by times: of an edge at a tick these may differ by rounding.
    lasts = np.searchsorted(places, np.arange(n + 1) * FINE, side="right") - 1
    return counts[::FINE], t[places], np.sign(np.diff(counts)[places - 1]), lasts


def logged(angle, duration):
    """Ticks, angles and speeds as a counter shows them that times its edges."""
    n = round(duration / DT)
    counts, edges, ways, lasts = passed(angle, n)
    tick, omega = np.arange(n + 1), np.zeros(n + 1)
    for k, latest in enumerate(lasts):
        if latest < 1 or ways[latest] != ways[latest - 1]:
            continue
        length, silence = edges[latest] - edges[latest - 1], k * DT - edges[latest]
        omega[k] = ways[latest] * COUNT / max(length, silence) * (silence < 0.1)
    return tick, counts * COUNT, omega


def logged_by_samples(angle, duration):
    """The same as a counter shows them whose capture unit keeps the last edge alone."""
    tick, theta, _ = logged(angle, duration)
    _, edges, _, lasts = passed(angle, len(tick) - 1)
    moved, omega = np.rint(np.diff(theta, prepend=theta[0]) / COUNT), np.zeros(len(tick))
    edge, way, rate = -1.0, 0.0, 0.0
    for k, last in enumerate(lasts):
        if moved[k]:
            follows = way == np.sign(moved[k])
            rate = moved[k] * COUNT / (edges[last] - edge) if follows else 0.0
            edge, way = edges[last], np.sign(moved[k])
            omega[k] = rate
        elif way and k * DT - edge < 0.1:
            omega[k] = np.sign(rate) * min(abs(rate), COUNT / (k * DT - edge))
    return tick, theta, omega


def mean_over(angle, windows):
    """True mean speeds over windows from the samples on, cut off at the ends of the log."""
    at = np.clip(np.arange(len(windows))[:, None] * DT + windows, 0.0, (len(windows) - 1) * DT)
    length = at[:, 1] - at[:, 0]
    means = np.diff(angle(at), axis=1)[:, 0] / np.where(length > 0.0, length, 1.0)
    return np.where(length > 0.0, means, 0.0)


def swinging(t):
    return 0.21 + 0.06 * np.sin(12.0 * t) + 0.004 * np.sin(90.0 * t)


def stopping(t):
    # Runs, stands still inside of a count for half a second, and goes on the other way.
    return 0.4003 * COUNT + np.where(
        t < 0.3, 0.4 * (t - 0.3), np.where(t > 0.8, 0.3 * (0.8 - t), 0.0)
    )


def creeping(t):
    return 0.1 + 0.01 * np.sin(40.0 * t)


@pytest.mark.parametrize(
    ("angle", "error", "at_samples"),
    [(swinging, 0.004, 0.06), (creeping, 2e-4, 0.06), (stopping, 0.001, 0.02)],
)
def test_speeds_are_the_means_over_their_windows(angle, error, at_samples):
    tick, theta, omega = logged(angle, 1.2)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT)
    assert np.isnan(speeds.values).mean() < 0.01
    true = mean_over(angle, speeds.windows)
    assert np.sqrt(np.nanmean((speeds.values - true) ** 2)) < error
    # What the log shows is as far as this from the speed at the sample.
    exactly = (angle(tick * DT + 1e-6) - angle(tick * DT - 1e-6)) / 2e-6
    assert np.sqrt(np.mean((omega - exactly) ** 2)) > at_samples


def tossed(t):
    # Turns every few samples, at up to 8 counts a sample.
    return 0.21 + 0.02 * np.sin(2.0 * np.pi * 37.3 * t) + 0.004 * np.sin(2.0 * np.pi * 61.7 * t)


def test_bounds_that_a_counter_shows_before_a_turn_are_not_taken_for_means():
    """One count over the time since the last edge says nothing of the interval before that edge."""
    tick, theta, omega = logged(tossed, 3.0)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    at, h = tick * DT + speeds.windows.mean(axis=1), 1e-5
    speed = (tossed(at + h) - tossed(at - h)) / (2.0 * h)
    slope = (tossed(at + h) - 2.0 * tossed(at) + tossed(at - h)) / h**2
    ahead = (tossed(at + 2.0 * DT + h) - tossed(at + 2.0 * DT - h)) / (2.0 * h)
    error = speeds.values - mean_over(tossed, speeds.windows)
    before = np.isfinite(error) & (slope * speed < 0.0) & (ahead * speed < 0.0) & (tick > 3)
    assert before.sum() > 200
    assert abs(np.mean((error * np.sign(speed))[before])) < 0.03  # rad/s
    late = np.sum((error * slope)[before]) / np.sum(slope[before] ** 2)
    assert abs(late) < 3e-5  # s


@pytest.mark.parametrize("shown", [1.0, 0.9])  # of the bound, by the device in silence
def test_what_silence_tells_of_the_last_edge_is_believed_if_the_bounds_are_such(shown):
    tick, theta, omega = logged(creeping, 1.2)
    silent = (np.diff(theta, prepend=np.nan) == 0.0) & (np.diff(omega, prepend=np.nan) != 0.0)
    assert silent.sum() > 100
    omega = np.where(silent, shown * omega, omega)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT)
    error = speeds.values - mean_over(creeping, speeds.windows)
    assert np.sqrt(np.nanmean(error**2)) < (2e-4 if shown == 1.0 else 1e-3)


def dithering(t):
    # Over one edge and back, 40 times a second from half a second on.
    return np.where(t < 0.5, 0.4 * (t - 0.5), 0.3 * COUNT * np.sin(80.0 * np.pi * (t - 0.5)))


def test_of_one_turn_after_the_other_nothing_is_measured():
    """The device shows zero; when the edges were is known to a sample, of a handful."""
    tick, theta, omega = logged(dithering, 1.2)
    values = mean_speeds(tick, theta, omega, DT, COUNT).values
    later = tick * DT > 0.55
    assert (omega[later] == 0.0).all() and np.isnan(values[later][:-20]).all()
    assert np.isfinite(values[tick * DT < 0.45]).mean() > 0.99


@pytest.mark.parametrize("place", [0.3, 0.4, 0.5])  # of the turn in its sample
@pytest.mark.parametrize("before", [0.3, 1.4])  # samples, when its braking begins
def test_a_turn_over_an_edge_and_back_within_a_sample_begins_an_interval(before, place):
    """The count shows no change; the speed that follows is not from the edge that it showed."""

    def dipping(t):
        # Comes up, turns, and turns again 0.02 counts below an edge; the next is 1.04 samples on.
        u = t / DT - 20.0 - place
        early = 0.697 * before**2 - 1.394 * before * (u + before) - 2.0 * (u + before) ** 2
        return COUNT * (50.0 - 0.02 + np.where(u < -before, early, 0.697 * u**2))

    tick, theta, omega = logged(dipping, 30 * DT)
    assert (theta[21], omega[21]) == (theta[20], 0.0) and omega[22] == pytest.approx(0.59, abs=0.01)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    error = np.abs(speeds.values - mean_over(dipping, speeds.windows))[20:26]
    expected = speeds.jitter[20:26] * 1.394 * COUNT / DT**2
    assert np.isfinite(error[2]) and np.nanmax(error / np.hypot(expected, 0.02)) < 3.0


def cornered(t):
    # The speed goes up and down in straight lines between -1.5 and 1.5 rad/s, 23 times a second.
    u = (t * 23.0 + 0.13) % 1.0
    area = np.where(u < 0.5, u * (u - 0.5), (u - 0.5) * (1.0 - u))
    return 0.21 + 6.0 / 23.0 * area


@pytest.mark.parametrize("angle", [swinging, cornered])
def test_its_jitter_says_how_far_a_mean_may_be_off(angle):
    """Each error in parts of what the jitter makes of the true acceleration is about one."""
    tick, theta, omega = logged(angle, 1.2)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    middle = np.clip(tick * DT + speeds.windows.mean(axis=1), 1e-3, 1.2)
    slope = (angle(middle + 1e-5) - 2.0 * angle(middle) + angle(middle - 1e-5)) / 1e-10
    error = speeds.values - mean_over(angle, speeds.windows)
    expected = np.abs(slope) * speeds.jitter
    clear = np.isfinite(error) & (expected > 1e-3)
    assert 0.5 < np.sqrt(np.mean((error[clear] / expected[clear]) ** 2)) < 1.1


@pytest.mark.parametrize("angle", [swinging, cornered])
def test_errors_are_as_large_as_their_variances_say_where_the_speed_has_its_corners_too(angle):
    tick, theta, omega = logged(angle, 1.2)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT)
    record = Dataset(
        np.ones(len(tick)), speeds.values, DT,
        windows=speeds.windows[:, None], jitter=speeds.jitter[:, None],
    )  # fmt: skip
    error = speeds.values - mean_over(angle, speeds.windows)
    variance = scatter(record).variance[:, 0]
    parts = error / np.sqrt(variance + 0.001**2)
    # Most samples of the swing are known to less than what is added.
    assert 0.5 < np.sqrt(np.nanmean(parts[variance > 0.001**2] ** 2)) < 1.1
    assert np.nanmax(np.abs(parts)) < 5.0


def last_edges(angle, tick):
    """Times of the last edge up to each tick [s], NaN before the first."""
    _, edges, _, lasts = passed(angle, len(tick) - 1)
    return np.where(lasts < 0, np.nan, edges[lasts])


def surging(t):
    # 0.6 to 1.8 counts a sample, 31 times a second: edges that come one or two in a sample.
    return 0.21 + COUNT / DT * (1.2 * t - 0.6 / (62.0 * math.pi) * np.cos(62.0 * math.pi * t))


def test_edges_are_timed_by_those_before_and_behind_them():
    """Alone, in a sample, each would be known to 0.29 intervals, at most 0.29 samples."""
    tick, theta, omega = logged(surging, 0.6)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    moved = np.diff(theta, prepend=theta[0]) != 0.0
    begun = np.isfinite(speeds.values) & moved & (tick > 2) & (speeds.windows[:, 1] <= 0.0)
    late = (last_edges(surging, tick) - tick * DT - speeds.windows[:, 1])[begun] / DT
    alone = np.sqrt(np.mean(np.minimum(1.0, COUNT / (DT * speeds.values[begun])) ** 2 / 12.0))
    assert len(late) > 250 and alone > 0.2
    assert np.sqrt(np.mean(late**2)) < 0.5 * alone
    assert np.sqrt(np.mean((speeds.jitter[begun] / DT) ** 2)) < 0.5 * alone
    assert abs(np.mean(late)) < 0.03


def test_errors_of_when_means_were_go_on_as_their_colour_says():
    """From one edge to the next as far as the time between both is known."""
    tick, theta, omega = logged(surging, 4.0)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT)
    ends = tick * DT + speeds.windows[:, 1]
    fresh = np.append(True, np.diff(ends) > 1e-9) & np.isfinite(speeds.values)
    rows = np.flatnonzero(fresh & (speeds.windows[:, 1] > speeds.windows[:, 0]))
    begin, end = (tick[rows] * DT + speeds.windows[rows].T).astype(float)
    slope = [(surging(t + 1e-6) - surging(t - 1e-6)) / 2e-6 for t in (begin, end)]
    shift = (slope[1] - slope[0]) / (end - begin) * speeds.jitter[rows]
    error = (speeds.values - mean_over(surging, speeds.windows))[rows]
    clear = np.abs(shift) > 1e-3
    late = np.divide(error, shift, out=np.zeros(len(rows)), where=clear)
    clear &= np.abs(late) < 6.0
    pairs, colour = clear[1:] & clear[:-1], speeds.colour[rows][1:]
    for least, most in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.6), (0.6, 0.85), (0.85, 1.0)):
        alike = pairs & (colour > least) & (colour <= most)
        assert alike.sum() > 50
        before, behind = late[:-1][alike], late[1:][alike]
        shared = np.mean(before * behind) / np.sqrt(np.mean(before**2) * np.mean(behind**2))
        assert shared == pytest.approx(colour[alike].mean(), abs=0.2)


def on_uneven_wheel(angle, off):
    """The angle by edges that are off their places by parts of a count, over and over."""
    off = np.array(off)

    def seen(t):
        counts = angle(t) / COUNT
        place = np.floor(counts).astype(int)
        low, high = place + off[place % len(off)], place + 1 + off[(place + 1) % len(off)]
        return (place - (counts < low) + (counts >= high) + 0.5) * COUNT

    return seen


@pytest.mark.parametrize("angle", [swinging, surging])
def test_edges_that_are_unevenly_cut_make_speeds_err_by_that_and_no_more(angle):
    off = 0.0, 0.08, -0.05, 0.06
    uneven = np.sqrt(np.mean(np.diff(off, append=off[0]) ** 2))  # of a count between two edges
    tick, theta, omega = logged(on_uneven_wheel(angle, off), 1.2)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT)
    error = speeds.values - mean_over(angle, speeds.windows)
    fast = np.abs(speeds.values) > 0.2
    parts = error[fast] / speeds.values[fast]
    assert np.isnan(speeds.values).mean() < 0.01
    assert 0.8 * uneven < np.sqrt(np.mean(parts**2)) < 1.1 * uneven
    even = mean_speeds(*logged(angle, 1.2), DT, COUNT)
    assert np.sqrt(np.mean(speeds.jitter**2)) > 2.0 * np.sqrt(np.mean(even.jitter**2))


def test_a_speed_that_is_a_bound_is_told_from_one_that_is_none():
    """The edge came as long ago as the bound says, though the next speed shown is no less."""

    lengths = np.full(40, 0.9)
    lengths[20:22] = 0.98, 0.93
    edges = np.append(0.0, np.cumsum(lengths))
    edges += 20.03 - edges[20]  # from there on the next one is 0.98 samples away

    def pausing(t):
        return COUNT * (50.0 + np.interp(t / DT, edges, np.arange(len(edges))))

    tick, theta, omega = logged(pausing, 30 * DT)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    error = np.abs(last_edges(pausing, tick) - tick * DT - speeds.windows[:, 1])[21]
    assert omega[21] == pytest.approx(COUNT / DT / 0.97, rel=2e-3) and omega[22] > omega[21]
    assert error < 3.0 * speeds.jitter[21]


def shaking(t):
    return 0.21 + 0.06 * np.sin(2.0 * math.pi * 52.0 * t)  # up to 20 rad/s: 32 edges in a sample


def test_fast_motion_that_cannot_show_what_made_its_speeds_has_to_be_told():
    tick, theta, omega = logged(shaking, 0.6)
    assert mean_speeds(tick, theta, omega, DT, COUNT) is None
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    error = speeds.values - mean_over(shaking, speeds.windows)
    # Where the shaft turns round amid several edges the counter shows 0, which it never was.
    turns = (omega == 0.0) & (tick > 1)
    assert turns.sum() > 5 and np.isnan(speeds.values[turns]).all()
    assert np.isnan(speeds.values).mean() < 0.2
    assert np.sqrt(np.nanmean(error**2)) < 0.5


@pytest.mark.parametrize(
    ("angle", "error", "measured"),
    [(swinging, 0.004, 0.99), (tossed, 0.05, 0.6), (shaking, 0.15, 0.7)],
)
def test_speeds_that_are_means_of_all_counts_of_a_sample_are_recognised(angle, error, measured):
    tick, theta, omega = logged_by_samples(angle, 1.2)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    errors = speeds.values - mean_over(angle, speeds.windows)
    assert np.isfinite(errors).mean() > measured
    assert np.sqrt(np.nanmean(errors**2)) < error


def slipping(t):
    """To and fro at up to 11 rad/s, so fast that chords do not tell how the speed changes."""
    phase = 2.0 * math.pi * 120.3 * t
    swing = 8.2 * np.sin(phase) + 2.4 * np.sin(2.0 * phase + 0.2)
    return 0.21 - 3.6 * t + swing / (2.0 * math.pi * 120.3)


def test_speeds_of_last_intervals_that_look_like_those_of_whole_samples_are_told_by_the_edges():
    tick, theta, omega = logged(slipping, 0.4)
    speeds = mean_speeds(tick, theta, omega, DT, COUNT, by_edges=True)
    error = speeds.values - mean_over(slipping, speeds.windows)
    assert np.isfinite(error).mean() > 0.75
    assert np.sqrt(np.nanmean(error**2)) < 0.25
    # It was the last interval's end that lay close to the sample, not the sample's middle.
    assert np.median(speeds.windows[np.isfinite(error), 0]) > -0.5 * DT


@pytest.mark.parametrize("told", [True, False])
def test_who_says_that_edges_made_the_speeds_is_not_believed_against_the_log(told):
    tick, theta, _ = logged(swinging, 1.2)
    assert mean_speeds(tick, *smoothed(tick, theta), DT, COUNT, by_edges=told) is None


def test_a_shaft_that_stands_still_has_no_speed():
    tick, theta, omega = logged(stopping, 1.2)
    still = (tick * DT > 0.31) & (tick * DT < 0.79)
    assert np.abs(omega[still]).max() > 0.05  # what the counter cannot know better
    assert np.abs(mean_speeds(tick, theta, omega, DT, COUNT).values[still]).max() < 0.005


def test_a_shaft_that_has_stopped_for_good_has_no_speed_either():
    tick, theta, omega = logged(lambda t: stopping(np.minimum(t, 0.7)), 0.7)
    stopped = tick * DT > 0.31
    assert np.abs(omega[stopped]).max() > 0.05
    assert np.all(mean_speeds(tick, theta, omega, DT, COUNT).values[stopped] == 0.0)


def test_lost_samples_only_blur_when_edges_came():
    tick, theta, omega = logged(swinging, 1.2)
    kept = np.random.default_rng(3).random(len(tick)) > 0.2
    speeds = mean_speeds(tick[kept], theta[kept], omega[kept], DT, COUNT)
    windows = np.zeros((len(tick), 2))
    windows[kept] = speeds.windows
    errors = speeds.values - mean_over(swinging, windows)[kept]
    assert np.sqrt(np.nanmean(errors**2)) < 0.02


def test_the_direction_of_the_encoder_does_not_matter():
    tick, theta, omega = logged(swinging, 1.2)
    forwards = mean_speeds(tick, theta, omega, DT, COUNT)
    backwards = mean_speeds(tick, theta, omega, DT, -COUNT)
    np.testing.assert_array_equal(forwards.values, backwards.values)
    np.testing.assert_array_equal(forwards.windows, backwards.windows)


def exact(tick, theta):
    return swinging(tick * DT), np.gradient(swinging(tick * DT), DT)


def differences(tick, theta):
    return theta, np.diff(theta, prepend=theta[0]) / DT


def smoothed(tick, theta):
    kernel = np.exp(-np.arange(60) / 15.0)
    return theta, np.convolve(differences(tick, theta)[1], kernel / kernel.sum())[: len(theta)]


@pytest.mark.parametrize("made", [exact, differences, smoothed])
def test_speeds_that_no_edges_made_stay_as_they_are(made):
    tick, theta, _ = logged(swinging, 1.2)
    assert mean_speeds(tick, *made(tick, theta), DT, COUNT) is None


@pytest.mark.parametrize("ideal", [False, True])
def test_a_run_s_speeds_are_averaged_where_its_encoder_made_them(tmp_path, ideal):
    experiment = load_experiment("prbs.yaml")
    config, device = load_rig("simulated.yaml")
    device = SimulatedDevice(device.options.model_copy(update={"ideal": ideal}))
    folder = run_experiment(experiment.experiment, "run", config, device, tmp_path).folder
    model, recording = actuator(), load(folder)
    windows = from_recording(recording, model).dataset.windows
    averaged = windows.any(axis=(0, 2)).tolist() if windows.size else None
    assert averaged == (None if ideal else [name == "omega" for name in model.output_names])
    # A log without its run record says nothing of an encoder.
    (folder / "run.json").unlink()
    assert from_recording(load(folder), model).dataset.windows.size == 0
