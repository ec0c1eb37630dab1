"""Experiments that tell structures apart, where the best rival is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from sysid import (
    BatchSimulator,
    Excitation,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    Setting,
    State,
    discriminate,
)
from sysid.experiments.information import Informant
from sysid.experiments.prior import Prior
from sysid.experiments.rivals import Hypothesis, answer, contrast, refit
from sysid.experiments.tournament import AnsweredRun, Tournament, power, shortfall
from sysid.threads import Workers
from tests.sysid.support import blank

DT, NOISE = 0.01, 0.05
QUICK = {"noise": {"y": NOISE}, "candidates": 10, "generations": 3, "offspring": 4, "starts": 2}


def spring(name, law, *parameters):
    """Something whose output is a law of its input, at once."""
    return ProcessModel(
        name=name,
        states=(State("s", "1"),),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "N"),),
        parameters=tuple(
            Parameter(key, "1", value, low, high, minimum=-10.0)
            for key, value, low, high in parameters
        ),
        derivative=lambda x, u, p: (-x[0],),
        output=lambda x, u, p: (law(u[0], p),),
    )


STIFFNESS = ("k", 1.0, 0.2, 5.0)
LINEAR = spring("linear", lambda u, p: p[0] * u, STIFFNESS)
SQUARE = spring("square", lambda u, p: p[0] * u + p[1] * u * u, STIFFNESS, ("q", 0.3, -1.0, 1.0))
CUBIC = spring("cubic", lambda u, p: p[0] * u + p[1] * u * u * u, STIFFNESS, ("c", 0.3, -1.0, 1.0))


def growth():
    """A lag, or what grows without end, by the sign of its rate."""
    return ProcessModel(
        name="growth",
        states=(State("y", "N"),),
        inputs=(Input("u", "m"),),
        outputs=(Output("y", "N"),),
        parameters=(Parameter("rate", "1/s", -1.0, -5.0, 800.0, minimum=-10.0),),
        derivative=lambda x, u, p: (p[0] * x[0] + u[0],),
    )


def waves(lowest=0.0):
    """A triangle of a size about an offset."""

    def inputs(s):
        ramp = np.abs(np.linspace(-1.0, 1.0, 81)) * 2.0 - 1.0
        return (s["offset"] + s["size"] * ramp)[:, None]

    settings = {"size": Setting(0.1, 3.0, calm=0.1), "offset": Setting(lowest, 1.0, calm=0.0)}
    return Excitation("wave", settings, inputs, DT)


def structure(model, output_noise=NOISE):
    space, simulator = SearchSpace.of(model), BatchSimulator(model)
    prior = Prior.of_ranges(space)
    noise = np.array([output_noise]), np.array([0.0])
    informant = Informant(simulator, space, *noise)
    return Hypothesis(model.name, simulator, informant, space, prior.values, prior.information())


def test_what_a_refitted_rival_leaves_is_that_of_the_closed_form():
    u = np.linspace(-0.5, 1.5, 60)
    truth, rival = structure(SQUARE), structure(LINEAR)
    told = answer(truth, blank(SQUARE, u[:, None], DT), 1)
    end, left = refit([told], rival, np.array([4.0]))
    y = u + 0.3 * u * u
    best = float(y @ u / (u @ u))
    assert end == pytest.approx([best], rel=1e-3)
    exact = np.sum((y - best * u) ** 2) / NOISE**2
    assert left == pytest.approx(exact, rel=1e-4)


def test_a_run_that_is_made_twice_counts_twice():
    u = np.linspace(-0.5, 1.5, 60)
    truth, rival, start = structure(SQUARE), structure(LINEAR), np.array([4.0])
    log, further = (answer(truth, blank(SQUARE, s * u[:, None], DT), 1) for s in (1.0, 0.3))
    again = replace(log)  # as much, and computed by itself
    end, left = refit([log, further, log], rival, start)
    end_of_both, left_of_both = refit([log, further, again], rival, start)
    assert end == pytest.approx(end_of_both, rel=1e-9)
    assert left == pytest.approx(left_of_both, rel=1e-9)


@pytest.mark.soak
def test_a_rival_is_fitted_to_noisy_logs_as_well_as_it_can_be():
    """Along Rosenbrock's valley, of which noise leaves a hundredth part to gain."""
    valley = spring(
        "valley",
        lambda u, p: (1.0 - u) * p[0] + u * 10.0 * (p[1] - p[0] * p[0]),
        ("k", 1.0, -2.0, 2.0),
        ("q", 1.0, -1.0, 3.0),
    )
    u, rng = np.arange(2000) % 2.0, np.random.default_rng(0)
    rival = structure(valley, 100.0 * NOISE)
    exact = answer(rival, blank(valley, u[:, None], DT), 1)
    noise = 100.0 * NOISE * rng.standard_normal(exact.outputs.shape)
    log = replace(exact, outputs=exact.outputs + noise)
    end, left = refit([log], rival, np.array([-1.2, 1.0]))
    halves = [log.outputs[u == side, 0] for side in (0.0, 1.0)]
    least = sum(float(np.sum((y - y.mean()) ** 2)) for y in halves) / (100.0 * NOISE) ** 2
    assert left == pytest.approx(least, abs=1.0)
    assert contrast(log, rival, end).joint[-1, -1] == pytest.approx(left)


@pytest.mark.soak
def test_a_rival_that_blows_up_on_its_way_is_fitted_all_the_same():
    grows = growth()
    one = structure(grows)
    told = answer(one, blank(grows, np.ones((60, 1)), DT), 4)
    for start in (3.0, 790.0):
        end, _ = refit([told], one, np.array([start]))
        assert np.isfinite(end).all()
    assert refit([told], one, np.array([3.0]))[0] == pytest.approx([-1.0], rel=1e-3)


def test_of_several_starts_the_one_that_leaves_least_goes_on():
    """Of a sine's frequency there are many minima; none is at the end of the range."""
    wave = spring("wave", lambda u, p: np.sin(p[0] * u), ("w", 12.0, 1.0, 400.0))
    rival = structure(wave)
    told = answer(rival, blank(wave, np.linspace(-3.0, 3.0, 200)[:, None], DT), 1)
    starts = [np.array([w]) for w in (3.3, 150.0, 11.5, 60.0)]
    end, left = refit([told], rival, *starts)
    assert end == pytest.approx([12.0], rel=1e-4)
    assert left < 0.1 < refit([told], rival, starts[0])[1]


def test_a_pair_that_nothing_tells_does_not_hold_the_others_back():
    assert shortfall(np.array([0.01, 12.0])) < shortfall(np.array([0.02, 6.0]))
    assert shortfall(np.array([40.0, 40.0])) < shortfall(np.array([10.0, 1e6]))
    assert shortfall(np.array([2e4, 2e4])) < shortfall(np.array([1e4, 1e4]))


@pytest.mark.soak
def test_the_runs_that_tell_pairs_apart_are_at_the_limits_and_beside_zero():
    models = {"linear": LINEAR, "square": SQUARE, "cubic": CUBIC}
    result = discriminate(models, [waves(-1.0)], limits={"u": (-2.0, 2.0)}, runs=2, **QUICK)
    contests = {(c.truth, c.rival): c for c in result.contests}
    assert len(contests) == 6
    for truth in ("square", "cubic"):
        for rival in {"linear", "square", "cubic"} - {truth}:
            assert contests[truth, rival].probability > 0.999
    # A spring with another term does what a linear one does, without it.
    for rival in ("square", "cubic"):
        contest = contests["linear", rival]
        assert not contest.possible
        assert contest.distance < 1e-3
        assert contest.values["k"] == pytest.approx(1.0, rel=1e-3)
    assert result.inseparable == ()
    assert set(result.nested) == {("linear", "square"), ("linear", "cubic")}
    for run in result.runs:
        reach = np.abs(run.inputs).max()
        assert 1.5 < reach <= 1.8


@pytest.mark.soak
def test_the_worst_pair_is_as_far_apart_as_a_search_of_all_runs_finds():
    models = {"square": SQUARE, "cubic": CUBIC}
    more = {**QUICK, "candidates": 24, "generations": 12, "offspring": 8}
    result = discriminate(models, [waves()], limits={"u": (-1.0, 1.0)}, runs=1, **more)
    best = 0.0
    excitation = waves()
    for size in np.linspace(0.1, 0.9, 30):
        for offset in np.linspace(0.0, 0.9 - size, 20):
            u = excitation.inputs({"size": size, "offset": offset})[:, 0]
            square, cubic = u + 0.3 * u**2, u + 0.3 * u**3
            left = []
            for y, power_of_u in ((square, u**3), (cubic, u**2)):
                columns = np.column_stack([u, power_of_u])
                fitted = columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
                left.append(np.sum((y - fitted) ** 2) / NOISE**2)
            best = max(best, min(left))
    worst = min(contest.distance for contest in result.contests)
    assert 0.85 * best < worst <= 1.01 * best


def test_a_run_in_which_a_rival_fails_tells_nothing():
    one = structure(growth())
    told = answer(one, blank(growth(), np.ones((60, 1)), DT), 4)
    tournament = Tournament([one, one], Workers(1), np.random.default_rng(0))
    tournament.points = [[np.array([0.5]), np.array([5000.0])]]
    run = AnsweredRun(waves(), np.zeros(2), tournament.unjudged(), (told, told))
    told_by_it = tournament.judged(run).information
    assert told_by_it[0, -1, -1] > 1.0
    assert not told_by_it[1].any()


@pytest.mark.parametrize(("level", "steady"), [(10.0, True), (0.0, False)])
def test_a_run_whose_states_bend_within_the_noise_is_not_steady(level, steady):
    square_law = ProcessModel(
        name="square_law",
        states=(State("x", "1"),),
        inputs=(Input("u", "1"),),
        outputs=(Output("x", "1"),),
        parameters=(Parameter("rate", "1/s", 5.0, 1.0, 20.0),),
        derivative=lambda x, u, p: (p[0] * (u[0] * u[0] - x[0]),),
    )
    space, simulator = SearchSpace.of(square_law), BatchSimulator(square_law)
    informant = Informant(simulator, space, np.array([1e-3]), np.array([1.0]))
    prior = Prior.of_ranges(space)
    truth = Hypothesis("square_law", simulator, informant, space, prior.values, prior.information())
    inputs = level + 0.1 * np.sin(np.arange(300) * 0.1)
    assert answer(truth, blank(square_law, inputs[:, None], DT), 2).steady == steady


def test_one_seed_gives_one_result_whatever_the_threads(monkeypatch):
    models, few = {"square": SQUARE, "cubic": CUBIC}, {**QUICK, "candidates": 4, "generations": 1}
    several = discriminate(models, [waves()], runs=1, **few)
    monkeypatch.setattr("sysid.experiments.discrimination.available_cores", lambda: 1)
    alone = discriminate(models, [waves()], runs=1, **few)
    assert several.runs[0].settings == alone.runs[0].settings
    assert several.contests == alone.contests


@pytest.mark.soak
def test_structures_that_do_the_same_are_told_apart_by_no_run():
    twin = spring("twin", lambda u, p: 2.0 * p[0] * u, ("half", 0.6, 0.1, 2.5))
    with pytest.raises(ModelError, match="no run within the limits tells any"):
        discriminate({"a": LINEAR, "b": twin}, [waves()], **QUICK)
    result = discriminate({"a": LINEAR, "b": twin, "cubic": CUBIC}, [waves()], runs=1, **QUICK)
    assert result.inseparable == (("a", "b"),)


def test_the_power_of_the_test_is_how_often_it_refuses_the_rival():
    rng, u = np.random.default_rng(0), np.linspace(0.0, 0.6, 30)
    y = u + 0.3 * u * u
    left = y - u * float(y @ u / (u @ u))
    along = left / np.linalg.norm(left)
    distance = float(left @ left) / NOISE**2
    logs = y + NOISE * rng.standard_normal((20_000, len(u)))
    refused = logs @ along / NOISE > norm.isf(0.01)
    assert float(refused.mean()) == pytest.approx(float(power(distance)), abs=0.01)


@pytest.mark.parametrize(
    ("models", "options", "named"),
    [
        ({"a": LINEAR}, {}, "name two structures at least"),
        (
            {"a": LINEAR, "b": CUBIC.with_outputs(("s",))},
            {},
            "structures have the same inputs and outputs, in one order: linear has y, cubic s",
        ),
        ({"a": LINEAR, "b": CUBIC}, {"limits": {"v": (0.0, 1.0)}}, "no structure has a signal 'v'"),
        ({"a": LINEAR, "b": CUBIC}, {"limits": {"u": (-0.01, 0.01)}}, "would pass a limit"),
    ],
)
def test_mistakes_are_named(models, options, named):
    with pytest.raises(ModelError, match=named):
        discriminate(models, [waves()], **{**QUICK, **options})


@pytest.mark.soak
def test_a_rival_that_holds_the_truth_is_fitted_from_the_truth():
    frequency = ("w", 12.0, 1.0, 400.0)
    plain = spring("plain", lambda u, p: np.sin(p[0] * u), frequency)
    more = spring(
        "more",
        lambda u, p: np.sin(p[0] * u) + p[1] * u * u,
        ("w", 3.3, 1.0, 400.0),  # where a descent ends in a minimum of its own
        ("q", 0.3, -1.0, 1.0),
    )
    contests = discriminate({"plain": plain, "more": more}, [waves()], runs=2, **QUICK).contests
    (contest,) = (c for c in contests if c.truth == "plain")
    assert contest.distance < 0.1
    assert contest.values["w"] == pytest.approx(12.0, rel=1e-3)
