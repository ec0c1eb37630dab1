"""Outputs that a sensor averages before they are read, against the exact response of a lag."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

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
from sysid.arrays import FloatArray
from sysid.engine.filter_kernel import FilterKernel
from sysid.engine.filter_settings import FilterSettings
from sysid.examples import lag
from sysid.fitting.innovations import Innovations
from sysid.fitting.means import each_mean_once, scatter
from sysid.fitting.objective import Objective
from sysid.problem.space import SearchSpace
from sysid.uncertainty.profile import profile

DT, TAU = 1e-3, 0.05
N = 300


def rising(t):
    """A unit step's response, and the area under it."""
    fading = np.exp(-t / TAU)
    return 1.0 - fading, t - TAU * (1.0 - fading)


def averaged_step():
    """A step's exact response, averaged over times that end up to 4 ms before each sample."""
    before = np.sort(np.random.default_rng(0).uniform(-0.012, 0.0, (N, 2)), axis=1)
    before[:, 1] = np.maximum(before[:, 1], before[:, 0] + 1e-4)
    before[::7] = -0.002  # instants
    t = np.arange(N) * DT
    begin, end = np.clip(t[:, None] + before, 0.0, t[-1]).T
    means = np.diff([rising(begin)[1], rising(end)[1]], axis=0)[0] / np.maximum(end - begin, 1e-9)
    means = np.where(end - begin < 1e-9, rising(end)[0], means)
    return Dataset(np.ones(N), means, DT, windows=before[:, None])


def test_simulated_outputs_are_averaged_over_the_windows():
    record = averaged_step()
    simulator = BatchSimulator(lag(), accuracy=1e-8)
    simulated = simulator.trajectories(np.array([1.0, TAU]), record)[0]
    np.testing.assert_allclose(simulated, record.outputs, atol=1e-7)
    at_samples = simulator.trajectories(np.array([1.0, TAU]), replace(record, windows=np.zeros(0)))
    assert np.abs(at_samples[0] - record.outputs).max() > 0.1
    result = simulator.errors(np.array([1.0, TAU]), [record])
    assert result.sse[0, 0, 0] < 1e-10
    doubled = replace(record, outputs=2.0 * record.outputs)
    result = simulator.errors(np.array([1.0, TAU]), [doubled])
    known = (
        record.time + record.windows[:, 0, 0] > -1e-9
    )  # the rest was averaged over what was before
    assert result.sse[0, 0, 0] == pytest.approx(np.sum(record.outputs[known] ** 2), rel=1e-5)


def test_a_sensor_that_averages_does_not_slow_the_model_down():
    record = averaged_step()
    settings = {"population": 40, "generations": 10, "random_state": 0}
    exact = GASSI(lag(), **settings).fit(record)
    assert exact.parameters_["tau"] == pytest.approx(TAU, rel=1e-3)
    blind = GASSI(lag(), **settings).fit(replace(record, windows=np.zeros(0)))
    assert blind.parameters_["tau"] > 1.05 * TAU


@pytest.mark.parametrize("corrects", [False, True])
def test_the_filter_sees_them_alike(corrects):
    record = replace(averaged_step(), input_noise=np.array([1e-9]))
    model = lag().with_initial({"y": 0.0})  # not a sample, which has noise
    simulator, p = BatchSimulator(model), np.array([[0.9, 1.1 * TAU]])
    common = p, [record], [np.ones(1)], np.array([[4]]), [None]
    plain = simulator.residuals(*common).values
    filtered = simulator.innovations(
        *common, [FilterSettings(np.array([0.1]), corrects=corrects)]
    ).values
    np.testing.assert_allclose(filtered[1:], plain[1:], atol=1e-6)


def test_a_free_run_that_diverges_has_no_means_and_warns_of_none():
    record = replace(averaged_step(), input_noise=np.array([1e-9]))
    filtered = BatchSimulator(lag().with_initial({"y": 0.0})).innovations(
        np.array([[1.0, -1e-6]]),
        [record],
        [np.ones(1)],
        np.array([[1]]),
        [None],
        [FilterSettings(np.ones(1))],
    )
    assert not np.isfinite(filtered.values).all()


def test_the_filter_of_means_is_made_once(monkeypatch):
    made = []

    class Counted(FilterKernel):
        def text(self, **options):
            made.append(self)
            return super().text(**options)

    monkeypatch.setattr("sysid.engine.compiler.FilterKernel", Counted)
    record = replace(averaged_step(), input_noise=np.array([1e-9]))
    model = lag().with_initial({"y": 0.5})
    for tau in (TAU, 2.0 * TAU):
        BatchSimulator(model).innovations(
            np.array([[1.0, tau]]),
            [record],
            [np.ones(1)],
            np.array([[1]]),
            [None],
            [FilterSettings(np.ones(1))],
        )
    assert len(made) == 1


def test_of_means_over_the_last_sample_innovations_are_those_of_a_kalman_filter():
    """The lag's output and its input's error at the sample before tell each mean exactly."""
    rng = np.random.default_rng(0)
    u, y = rng.choice([-1.0, 1.0], 80), rng.standard_normal(80)
    y[[30, 31]] = np.nan
    windows = np.sort(rng.uniform(-DT, 0.0, (80, 1, 2)), axis=2)
    record = Dataset(u, y, DT, input_noise=np.array([0.3]), windows=windows)
    scatter = rng.uniform(0.0, 0.1, (80, 1))
    filtered = BatchSimulator(lag().with_initial({"y": 0.0})).innovations(
        np.array([[2.0, TAU]]), [record], [np.ones(1)], np.array([[1]]), [None],
        [FilterSettings(np.array([0.2]), scatter)],
    )  # fmt: skip
    # States are the output and the input's error at the sample before.
    x, P, fading = np.zeros(2), np.diag([0.0, 0.3**2]), np.exp(-DT / TAU)
    expected = np.zeros(80)
    for k in range(1, 80):
        begin, end = windows[k, 0] + DT
        mean = TAU * (np.exp(-begin / TAU) - np.exp(-end / TAU)) / (end - begin)
        H, F = np.array([mean, 2.0 * (1.0 - mean)]), np.array([fading, 2.0 * (1.0 - fading)])
        driven = np.array([0.0, u[k - 1]])
        if np.isfinite(y[k]):
            s = H @ P @ H + 0.2**2 + scatter[k, 0]
            e = H @ (x + driven) - y[k]
            expected[k] = e * 0.2 / np.sqrt(s)
            x, P = x - P @ H / s * e, P - np.outer(P @ H, P @ H) / s
        x, P = np.array([F @ (x + driven), 0.0]), np.diag([F @ P @ F, 0.3**2])
    np.testing.assert_allclose(filtered.values[:, 0, 0], expected, atol=1e-7)


def test_when_means_were_is_a_state_of_a_kalman_filter_that_goes_on_by_its_colour():
    """Its error moves each mean by the shift, and is a part of that of the mean before."""
    rng = np.random.default_rng(3)
    u, y = rng.choice([-1.0, 1.0], 80), rng.standard_normal(80)
    y[[30, 31]] = np.nan
    windows = np.sort(rng.uniform(-DT, 0.0, (80, 1, 2)), axis=2)
    shift, rest = rng.uniform(-0.5, 0.5, (80, 1)), rng.uniform(0.0, 0.1, (80, 1))
    colour = np.where(np.isfinite(y), rng.uniform(0.0, 1.0, 80), 1.0)[:, None]
    record = Dataset(u, y, DT, input_noise=np.array([0.3]), windows=windows)
    filtered = BatchSimulator(lag().with_initial({"y": 0.0})).innovations(
        np.array([[2.0, TAU]]), [record], [np.ones(1)], np.array([[1]]), [None],
        [FilterSettings(np.array([0.2]), rest + shift**2, shift, colour)],
    )  # fmt: skip
    # States are the output and the input's error at the sample before, and when the mean was.
    x, P, fading = np.zeros(3), np.diag([0.0, 0.3**2, 1.0]), np.exp(-DT / TAU)
    expected = np.zeros(80)
    for k in range(1, 80):
        begin, end = windows[k, 0] + DT
        mean = TAU * (np.exp(-begin / TAU) - np.exp(-end / TAU)) / (end - begin)
        lasting = colour[k, 0]
        x[2] *= lasting
        P = np.diag([1.0, 1.0, lasting]) @ P @ np.diag([1.0, 1.0, lasting])
        P[2, 2] += 1.0 - lasting**2
        H = np.array([mean, 2.0 * (1.0 - mean), shift[k, 0]])
        driven = np.array([0.0, u[k - 1], 0.0])
        if np.isfinite(y[k]):
            s = H @ P @ H + 0.2**2 + rest[k, 0]
            e = H @ (x + driven) - y[k]
            expected[k] = e * 0.2 / np.sqrt(s)
            x, P = x - P @ H / s * e, P - np.outer(P @ H, P @ H) / s
        F = np.array([[fading, 2.0 * (1.0 - fading), 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        x, P = F @ (x + driven), F @ P @ F.T + np.diag([0.0, 0.3**2, 0.0])
    np.testing.assert_allclose(filtered.values[:, 0, 0], expected, atol=1e-7)


def test_without_corrections_when_means_were_is_a_part_of_their_variance():
    """However it goes on: nothing is taken in that could tell."""
    rng, windows = np.random.default_rng(4), np.tile([-DT, 0.0], (80, 1, 1))
    record = Dataset(
        rng.standard_normal(80),
        rng.standard_normal(80),
        DT,
        input_noise=np.ones(1),
        windows=windows,
    )
    scatter, shift = np.full((80, 1), 0.3), np.full((80, 1), 0.5)
    with_shift, without = (
        BatchSimulator(lag()).innovations(
            np.array([[2.0, TAU]]), [record], [np.ones(1)], np.array([[1]]), [None],
            [FilterSettings(np.array([0.2]), scatter, each, 0.9, corrects=False)],
        ).values
        for each in (shift, 0.0)
    )  # fmt: skip
    np.testing.assert_allclose(with_shift, without, rtol=1e-9)


def test_colours_of_means_go_on_over_those_that_are_left_out():
    """Of two means that end in a sample the first is left out, not what the next has of it."""
    ends = np.array([0.5, 1.5, 1.8, 2.6, 3.4])
    windows = np.stack([np.append(0.0, ends[:-1]), ends], axis=1) - np.arange(5)[:, None]
    colour = np.array([0.0, 0.9, 0.8, 0.5, 0.0])[:, None]
    record = Dataset(
        np.ones(5), np.ones(5), 1.0, windows=windows[:, None], jitter=np.full((5, 1), 0.1),
        jitter_colour=colour,
    )  # fmt: skip
    once = each_mean_once(record)
    assert np.isfinite(once.outputs[:, 0]).tolist() == [True, True, True, True, True]
    np.testing.assert_allclose(once.jitter_colour[1:, 0], [0.0, 0.72, 0.5, 1e-3])


def test_of_means_over_many_samples_innovations_are_those_of_their_joint_normal():
    """Each mean is a sum of the inputs' errors, and an innovation what none before tells of it."""
    rng = np.random.default_rng(1)
    u, ends = rng.choice([-1.0, 1.0], 80), np.sort(rng.uniform(1.0, 79.0, 30))
    begins = np.append(0.0, ends[:-1])
    # Each row tells of the mean that is being taken, as an encoder's log does.
    interval = np.minimum(np.searchsorted(ends, np.arange(80.0), side="right"), 29)
    means = rng.standard_normal(30)
    windows = np.stack([begins[interval], ends[interval]], axis=1) - np.arange(80)[:, None]
    record = Dataset(
        u, means[interval], DT, input_noise=np.array([0.3]), windows=windows[:, None] * DT
    )
    once = each_mean_once(record)
    rows = np.flatnonzero(np.isfinite(once.outputs[1:, 0])) + 1
    told = interval[rows - 1]
    np.testing.assert_allclose(once.outputs[rows, 0], means[told])
    assert 20 < len(rows) < 30  # of two that end within a sample one
    filtered = BatchSimulator(lag().with_initial({"y": 0.0})).innovations(
        np.array([[2.0, TAU]]),
        [once],
        [np.ones(1)],
        np.array([[1]]),
        [None],
        [FilterSettings(np.array([0.2]))],
    )
    # Area under the response to each sample's input, up to a time.
    since = np.maximum(np.stack([ends, begins])[:, told, None] - np.arange(80.0), 0.0) * DT
    area = 2.0 * (rising(since)[1] - rising(np.maximum(since - DT, 0.0))[1])
    H = (area[0] - area[1]) / ((ends - begins)[told, None] * DT)
    root = np.linalg.cholesky(0.3**2 * H @ H.T + 0.2**2 * np.eye(len(rows)))
    expected = 0.2 * np.linalg.solve(root, H @ u - means[told])
    np.testing.assert_allclose(filtered.values[rows, 0, 0], expected, atol=1e-6)
    assert not filtered.values[np.setdiff1d(np.arange(80), rows), 0, 0].any()


def test_jitter_of_windows_counts_by_how_fast_an_output_changes():
    """Means over windows that lie elsewhere than stated, drawn anew: their errors are as stated."""
    t, middles, deviation = DT * np.arange(N), DT * (np.arange(N) - 0.6), 0.25 * DT
    before, rng = np.tile([-1.0 * DT, -0.2 * DT], (N, 1)), np.random.default_rng(0)
    jitter, slope = np.full((N, 1), deviation), np.exp(-middles / TAU) / TAU
    variances, shifts = [], []
    for _ in range(400):
        at = t + deviation * rng.standard_normal(N)
        means = np.diff([rising(at - DT)[1], rising(at - 0.2 * DT)[1]], axis=0)[0] / (0.8 * DT)
        record = Dataset(np.ones(N), means, DT, windows=before[:, None], jitter=jitter)
        found = scatter(record)
        variances.append(found.variance[4:-4, 0])
        shifts.append(found.shift[4:-4, 0])
        assert np.all(found.shift**2 <= found.variance * (1.0 + 1e-9))
    expected = deviation * slope[4:-4]
    assert 0.97 < np.mean(np.mean(variances, axis=0) / expected**2) < 1.03
    # And which way a mean that is later errs.
    np.testing.assert_allclose(np.mean(shifts, axis=0), expected, rtol=0.1)


def test_a_run_tells_how_outputs_bend_between_means():
    """Means of a swing seven samples long, drawn anew; the run of it drifts and is a tenth off."""
    n, deviation, turning = 200, 0.25 * DT, 2.0 * np.pi / (7.3 * DT)
    t, rng = DT * np.arange(n), np.random.default_rng(0)

    def means(windows):
        begin, end = (t[:, None] + windows[:, 0]).T
        return (np.cos(turning * begin) - np.cos(turning * end)) / (turning * (end - begin))

    def run(record):
        return (1.1 * means(record.windows) + 0.5 * t / t[-1])[:, None]

    before = np.tile([-0.4 * DT, -0.2 * DT], (n, 1, 1))
    jitter, parts = np.full((n, 1), deviation), []
    for _ in range(200):
        measured = means(before + deviation * rng.standard_normal((n, 1, 1)))
        record = Dataset(np.ones(n), measured, DT, windows=before, jitter=jitter)
        errors = (measured - means(before))[4:-4] ** 2
        variances = (scatter(record, by).variance[4:-4, 0] for by in (run, None))
        parts.append([[np.mean(errors / s), np.mean(np.log(s))] for s in variances])
    (squares, logarithms), of_measured = np.mean(parts, axis=0)
    assert 0.85 < squares < 1.15
    # And closer to each error's own: chords are steep where the swing has its peaks.
    assert squares + logarithms < np.sum(of_measured) - 0.3


def test_a_part_keeps_its_windows():
    jitter = np.linspace(0.0, 1e-3, N)[:, None]
    record = replace(averaged_step(), jitter=jitter, jitter_colour=1e3 * jitter)
    part = record.part(50, 90, "part")
    np.testing.assert_array_equal(part.windows, record.windows[50:90])
    np.testing.assert_array_equal(part.jitter, record.jitter[50:90])
    np.testing.assert_array_equal(part.jitter_colour, record.jitter_colour[50:90])


@pytest.mark.parametrize("jitter", [np.zeros(5), np.full((5, 1), -1.0), np.full((5, 1), np.nan)])
def test_jitter_that_can_be_none_is_refused(jitter):
    with pytest.raises(ModelError, match=r"jitter must hold a finite number, 0 or more, for each"):
        Dataset(np.ones(5), np.zeros(5), DT, windows=np.zeros((5, 1, 2)), jitter=jitter)


@pytest.mark.parametrize("colour", [np.zeros(5), np.full((5, 1), -0.1), np.full((5, 1), np.nan)])
def test_a_colour_of_jitter_that_can_be_none_is_refused(colour):
    windows = np.zeros((5, 1, 2))
    with pytest.raises(ModelError, match=r"jitter_colour must hold a number from 0 to 1 for each"):
        Dataset(np.ones(5), np.zeros(5), DT, windows=windows, jitter_colour=colour)


@pytest.mark.parametrize(
    ("windows", "problem"),
    [
        (np.zeros((5, 1)), r"windows have shape \(5, 1\); give .*\(5, 1, 2\)"),
        (np.ones((5, 1, 2)) * [0.0, -1.0], "a window must begin before it ends"),
        (np.full((5, 1, 2), np.nan), "finite times"),
    ],
)
def test_windows_that_fit_no_outputs_are_refused(windows, problem):
    with pytest.raises(ModelError, match=problem):
        Dataset(np.ones(5), np.zeros(5), DT, windows=windows)


def test_a_mean_tells_what_a_cubic_has_beside_a_parabola():
    """Behind a step of the jerk the output is u s^3 / 6, a parabola (3 s^2 - s) u / 12."""
    model = ProcessModel(
        name="jerk",
        states=(State("y", "1"), State("v", "1/s"), State("a", "1/s^2")),
        inputs=(Input("u", "1/s^3"),),
        outputs=(Output("y", "1"),),
        parameters=(Parameter("gain", "1", 1.0, 0.1, 10.0),),
        derivative=lambda x, u, p: (x[1], x[2], p[0] * u[0]),
    )
    begin, end = -0.3, -0.1
    windows = np.tile([begin, end], (4, 1, 1))
    windows[2] = -0.3  # an instant
    record = Dataset(np.full(4, 6.0), np.zeros(4), 1.0, windows=windows)
    beyond = BatchSimulator(model).beyond_parabolas(np.ones(1), record)[0, :, 0]
    a, b = 1.0 + begin, 1.0 + end
    cubic = (b**4 - a**4) / 4.0
    parabola = (b**3 - a**3) / 2.0 - (b**2 - a**2) / 4.0
    # The part of a cubic that is none is the same in every sample.
    np.testing.assert_allclose(beyond[[1, 3]], np.full(2, (cubic - parabola) / (b - a)), rtol=1e-2)
    assert beyond[2] == pytest.approx(a**3 - (1.5 * a**2 - 0.5 * a), rel=1e-2)


def fast_lag(tau: float, u: FloatArray, windows: FloatArray) -> FloatArray:
    """Means over windows (n, 1, 2) within a sample of a lag's response to a held input, (n,)."""
    y, means = 0.0, np.zeros(len(u))
    for k in range(1, len(u)):
        begin, end = windows[k, 0] + DT
        fading = tau * (np.exp(-begin / tau) - np.exp(-end / tau)) / (end - begin)
        means[k] = u[k - 1] + (y - u[k - 1]) * fading
        y = u[k - 1] + (y - u[k - 1]) * np.exp(-DT / tau)
    return means


def test_a_profile_is_of_the_means_themselves_however_far_it_goes():
    """Of a lag faster than the samples, whose errors are closed: best gains are straight."""
    rng, tau, n = np.random.default_rng(3), 0.2 * DT, 120
    u, windows = rng.choice([-1.0, 1.0], n), np.sort(rng.uniform(-DT, 0.0, (n, 1, 2)), axis=2)
    measured = fast_lag(tau, u, windows) + 0.6 * rng.standard_normal(n)
    record = Dataset(u, measured, DT, input_noise=np.array([1e-9]), windows=windows)
    model = lag().with_initial({"y": 0.0})
    space = SearchSpace.of(model, {"tau": (0.01 * DT, 10.0 * DT)})
    objective = Objective(BatchSimulator(model, accuracy=1e-6), space, [record])

    def error(tau: float) -> tuple[float, float]:
        means = fast_lag(tau, u, windows)
        gain = float(means @ measured / (means @ means))
        return float(np.sqrt(np.mean((gain * means - measured) ** 2))), gain

    best = minimize_scalar(lambda log: error(np.exp(log))[0], np.log([0.3 * tau, 3.0 * tau])).x
    least, gain = error(np.exp(best))
    fitted = Innovations.of(objective, np.array([0.6]), corrects=True).exact_means
    found = profile(fitted, np.array([gain, np.exp(best)]), "tau")
    assert found.values[-1] > 1.5 * found.value
    worse = np.array([error(value)[0] - least for value in found.values])
    moved = found.statistic > 0.5
    scaled = found.statistic[moved] / worse[moved]
    np.testing.assert_allclose(scaled, scaled.mean(), rtol=0.05)


@pytest.mark.parametrize(("noise", "exact"), [(1e-3, True), (0.5, False)])
def test_a_filter_takes_no_parabolas_where_noise_does_not_cover_what_they_miss(noise, exact):
    """Of a lag five times faster than the samples: its response to a held input is closed."""
    rng, tau, n = np.random.default_rng(0), 0.2 * DT, 80
    u, windows = rng.choice([-1.0, 1.0], n), np.sort(rng.uniform(-DT, 0.0, (n, 1, 2)), axis=2)
    means = fast_lag(tau, u, windows)
    record = Dataset(u, means, DT, input_noise=np.array([1e-9]), windows=windows)
    model, p = lag().with_initial({"y": 0.0}), np.array([1.0, tau])
    objective = Objective(BatchSimulator(model), SearchSpace.of(model), [record])
    fitted = Innovations.of(objective, np.array([noise]), corrects=True).eased(p)
    assert fitted.exact == exact
    left = fitted.residuals(p[None], np.array([4])).values[1:, 0, 0] * objective.scales[0]
    assert (np.abs(left).max() < 0.01) == exact
    parabolas = Innovations.of(objective, np.array([noise]), corrects=True)
    # A place where nothing rings does not speak for the other.
    slow = np.array([1.0, 20.0 * DT])
    assert not parabolas.rings_at(slow[None])
    assert parabolas.rings_at(np.stack([slow, p])) == exact
