"""Experiments designed for a lag, whose information is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

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
    design,
)
from sysid.experiments.bench import FreeRun
from sysid.experiments.information import Informant
from tests.sysid.support import blank

DT = 0.01
NOISE = {"y": 0.05}


def lag(**start):
    """A lag whose gain is a product of two parameters, of which outputs tell no more."""
    return ProcessModel(
        name="two gains",
        states=(State("y", "m", **start),),
        inputs=(Input("u", "V"),),
        outputs=(Output("y", "m"),),
        parameters=(
            Parameter("a", "m/N", 2.0, 1.0, 4.0, "log"),
            Parameter("b", "N/V", 1.5, 1.0, 2.0, "log"),
            Parameter("tau", "s", 0.2, 0.1, 0.4, "log"),
        ),
        derivative=lambda x, u, p: ((p[0] * p[1] * u[0] - x[0]) / p[2],),
    )


def square(size, period):
    def inputs(settings):
        k = np.arange(200)
        wave = np.where(np.sin(2.0 * np.pi * (k + 0.5) * DT / settings["period"]) > 0.0, 1.0, -1.0)
        return settings["size"] * wave[:, None]

    return Excitation("square", {"size": size, "period": period}, inputs, DT)


SQUARE = square(Setting(0.1, 4.0), Setting(0.05, 4.0, log=True))
QUICK = {"candidates": 12, "generations": 3, "offspring": 6, "draws": 2}


def responses_to_step(n=60, gain=3.0, tau=0.2):
    """Derivatives of the response to a unit step by ln gain, ln tau and the start, (n, 3)."""
    t = DT * np.arange(n)
    decay = np.exp(-t / tau)
    return np.column_stack([gain * (1.0 - decay), -gain * t / tau * decay, decay])


def information_of_step(model, input_noise=0.0, jitter=0.0):
    noise = np.array([NOISE["y"]]), np.array([input_noise])
    informant = Informant(BatchSimulator(model), SearchSpace.of(model), *noise)
    record = replace(blank(model, np.ones((60, 1)), DT), jitter=np.full((60, 1), jitter))
    return informant.information(record, model.nominal[None])[0]


@pytest.mark.soak
def test_information_is_that_of_the_closed_form():
    slopes = responses_to_step()[:, :2] / NOISE["y"]
    exact = slopes.T @ slopes
    information = information_of_step(lag())
    assert information[np.ix_([0, 2], [0, 2])] == pytest.approx(exact, rel=1e-9)
    assert information[1] == pytest.approx(information[0], rel=1e-12)  # the other gain


def test_a_sample_of_which_the_instant_is_not_known_tells_less_the_faster_its_output():
    jitter, slopes = 0.01, responses_to_step()[:, :2]
    rates = np.gradient(slopes[:, 0], DT)
    errors = NOISE["y"] ** 2 + (rates * jitter) ** 2
    exact = slopes.T @ (slopes / errors[:, None])
    information = information_of_step(lag(), jitter=jitter)
    assert information[np.ix_([0, 2], [0, 2])] == pytest.approx(exact, rel=1e-3)
    assert exact[1, 1] < 0.8 * information_of_step(lag())[2, 2]


def test_the_number_of_threads_does_not_change_a_design(monkeypatch):
    shared = {"noise": NOISE, "limits": {"u": (-1.0, 1.0)}, "runs": 2, **QUICK}
    several = design(lag(), [SQUARE], **shared)
    monkeypatch.setattr("sysid.experiments.experiment.available_cores", lambda: 1)
    alone = design(lag(), [SQUARE], **shared)
    assert [run.settings for run in several.runs] == [run.settings for run in alone.runs]
    assert several.attempts == alone.attempts


def test_a_start_that_is_unknown_takes_its_part_of_the_information():
    slopes = responses_to_step() / NOISE["y"]
    exact = np.linalg.inv(np.linalg.inv(slopes.T @ slopes)[:2, :2])
    information = information_of_step(lag(initial_range=(-5.0, 5.0), first_sample=False))
    assert information[np.ix_([0, 2], [0, 2])] == pytest.approx(exact, rel=1e-9)


def pushed_step(n=60):
    """Slopes as of ``responses_to_step``, and the response to an input's errors, (n, n)."""
    decay = np.exp(-DT / 0.2)
    # To those of a held input, sample by sample.
    lags = np.subtract.outer(np.arange(n), np.arange(n)) - 1
    response = np.where(lags >= 0, 3.0 * (1.0 - decay) * decay ** np.maximum(lags, 0), 0.0)
    return responses_to_step(n)[:, :2], response


@pytest.mark.soak
def test_noise_of_an_input_counts_as_a_fit_that_compensates_it_scatters():
    (slopes, response), n, sigma = pushed_step(), 60, 0.3
    variances = NOISE["y"] ** 2 + sigma**2 * np.sum(response**2, axis=1)
    weighted = slopes / variances[:, None]
    rng = np.random.default_rng(1)
    errors = sigma * rng.standard_normal((20_000, n)) @ response.T
    errors += NOISE["y"] * rng.standard_normal(errors.shape)
    estimates = errors @ weighted @ np.linalg.inv(slopes.T @ weighted)
    information = information_of_step(lag(), sigma)[np.ix_([0, 2], [0, 2])]
    predicted = np.sqrt(np.diag(np.linalg.inv(information)))
    assert predicted == pytest.approx(estimates.std(axis=0), rel=0.15)
    without = np.linalg.inv(information_of_step(lag())[np.ix_([0, 2], [0, 2])])
    assert np.all(predicted > 3.0 * np.sqrt(np.diag(without)))


@pytest.mark.parametrize("size", [0.3, 0.01])
def test_where_it_is_known_when_outputs_are_measured_a_filter_takes_an_inputs_noise_out(size):
    """Then what is told is what the errors' covariance leaves; jitter that is next to none."""
    slopes, response = pushed_step()
    covariance = NOISE["y"] ** 2 * np.eye(len(slopes)) + size**2 * response @ response.T
    exact = slopes.T @ np.linalg.solve(covariance, slopes)
    information = information_of_step(lag(), size, jitter=1e-9)[np.ix_([0, 2], [0, 2])]
    assert information == pytest.approx(exact, rel=1e-6)
    assert np.all(np.diag(exact) < 0.99 * np.diag(slopes.T @ slopes) / NOISE["y"] ** 2)


def test_the_designed_runs_tell_more_than_any_of_those_tried_at_random():
    shared = {"noise": NOISE, "limits": {"u": (-1.0, 1.0)}, "runs": 2, "draws": 2}
    drawn = design(lag(), [SQUARE], candidates=40, generations=0, **shared)
    grown = design(lag(), [SQUARE], candidates=40, generations=6, **shared)
    assert grown.duration == pytest.approx(4.0)
    assert sum(np.log(q.after) for q in grown.quantities) < sum(
        np.log(q.after) for q in drawn.quantities
    )
    # The best there is uses all that the limit and its margin leave.
    sizes = [run.settings["size"] for run in grown.runs]
    assert sizes == pytest.approx([0.9, 0.9], rel=0.05)
    assert max(sizes) <= 0.9


def test_predicted_intervals_are_what_a_repeated_estimate_scatters_by():
    result = design(lag(), [SQUARE], noise=NOISE, limits={"u": (-1.0, 1.0)}, runs=1, **QUICK)
    (run,) = result.runs
    rng, gain, tau = np.random.default_rng(0), 3.0, 0.2
    y = np.zeros(len(run.inputs))
    slopes = np.zeros((len(y), 2))
    decay = np.exp(-DT / tau)
    for k, u in enumerate(run.inputs[:-1, 0]):  # exact for a held input
        y[k + 1] = gain * u + (y[k] - gain * u) * decay
        slopes[k + 1, 0] = gain * u + (slopes[k, 0] - gain * u) * decay
        slopes[k + 1, 1] = slopes[k, 1] * decay + (y[k] - gain * u) * decay * DT / tau
    noise = NOISE["y"] * rng.standard_normal((4000, len(y)))
    estimates = noise @ slopes @ np.linalg.inv(slopes.T @ slopes)
    scatter = 1.96 * estimates.std(axis=0)
    after = {quantity.name: quantity.after for quantity in result.quantities}
    # What the ranges tell beside the run narrows them by less than this.
    assert [after["a b"], after["tau"]] == pytest.approx(scatter, rel=0.05)


def test_no_run_passes_a_limit_with_any_parameters_that_are_plausible():
    limits = {"y": (-2.0, 2.0)}
    result = design(lag(), [SQUARE], noise=NOISE, limits=limits, checks=32, runs=2, **QUICK)
    assert result.refused > 0
    largest = 4.0 * 2.0  # of the gain, over the ranges
    for run in result.runs:
        assert largest * run.settings["size"] < 2.0 * 1.6  # draws seldom reach both corners
        record = blank(lag(), run.inputs, run.dt)
        nominal = BatchSimulator(lag()).trajectories(lag().nominal, record)
        assert np.abs(nominal).max() < 2.0


def test_where_every_run_would_pass_a_limit_it_says_so():
    with pytest.raises(ModelError, match="each of 12 runs that were tried would pass a limit"):
        design(lag(), [SQUARE], noise=NOISE, limits={"u": (-0.01, 0.01)}, **QUICK)


def test_runs_are_added_until_the_targets_are_met():
    shared = {"noise": NOISE, "limits": {"u": (-1.0, 1.0)}, "runs": 4, **QUICK}
    easy = design(lag(), [SQUARE], targets={"tau": 0.05}, **shared)
    assert len(easy.runs) == 1
    assert easy.met
    hard = design(lag(), [SQUARE], targets={"tau": 1e-4, "a b": 0.05}, **shared)
    assert len(hard.runs) == 4
    assert not hard.met
    assert [quantity.name for quantity in hard.quantities if not quantity.met] == ["tau"]


def test_runs_are_added_where_those_chosen_tell_less_than_the_search_held():
    class Sobering:
        """Tells of a run that it knows already that its samples' instants err."""

        def __init__(self):
            self.free, self.asked = FreeRun(BatchSimulator(lag())), set()

        def records(self, inputs, dt, vectors):
            (record, *_) = self.free.records(inputs, dt, vectors)
            errs = 0.01 if inputs.tobytes() in self.asked else 0.0
            self.asked.add(inputs.tobytes())
            return [replace(record, jitter=np.full((len(inputs), 1), errs))] * len(vectors)

    shared = {"noise": NOISE, "targets": {"tau": 0.004}, "runs": 6, **QUICK}
    easy = design(lag(), [SQUARE], **shared)
    sobered = design(lag(), [SQUARE], bench=Sobering(), **shared)
    assert len(easy.runs) < len(sobered.runs)
    assert easy.met and sobered.met


def test_what_no_experiment_tells_is_refused_with_what_would():
    with pytest.raises(ModelError, match=r"a: no experiment tells it, .* ask for a b, or fix"):
        design(lag(), [SQUARE], noise=NOISE, targets={"a": 0.01}, **QUICK)
    with pytest.raises(ModelError, match="c: there is no such quantity; there are tau, a b"):
        design(lag(), [SQUARE], noise=NOISE, quantities=["c"], **QUICK)


def test_no_design_gains_along_what_the_equations_leave_undetermined():
    along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    for seed in range(5):
        result = design(lag(), [SQUARE], noise=NOISE, seed=seed, **QUICK)
        assert abs(along @ result.information @ along) < 1e-10 * np.abs(result.information).max()
        assert [group.parameters for group in result.tied] == [("a", "b")]


def test_runs_whose_simulation_errs_along_what_nothing_tells_are_left_out(monkeypatch):
    exact, asked = Informant.information, []

    def erring(informant, record, chromosomes):
        asked.append(informant)
        information = exact(informant, record, chromosomes)
        large = (finest or informant is asked[0]) and np.abs(record.inputs).max() > 0.5
        return information + large * 1e-6 * np.abs(information).max() * np.eye(3)

    monkeypatch.setattr(Informant, "information", erring)
    finest = True
    result = design(lag(), [SQUARE], noise=NOISE, **QUICK)
    assert 0 < result.phantoms < result.attempts
    assert all(np.abs(run.inputs).max() <= 0.5 for run in result.runs)
    asked.clear()
    finest = False  # the search's coarser steps alone
    result = design(lag(), [SQUARE], noise=NOISE, **QUICK)
    assert result.phantoms == 0
    assert any(np.abs(run.inputs).max() > 0.5 for run in result.runs)
    monkeypatch.undo()
    assert design(lag(), [SQUARE], noise=NOISE, **QUICK).phantoms == 0


def test_earlier_information_leaves_less_to_gain():
    shared = {"noise": NOISE, "limits": {"u": (-1.0, 1.0)}, "runs": 1, **QUICK}
    first = design(lag(), [SQUARE], **shared)
    second = design(lag(), [SQUARE], before=first.information, **shared)
    for once, twice in zip(first.quantities, second.quantities, strict=True):
        assert twice.before == pytest.approx(once.after, rel=1e-6)
        assert twice.after < 0.8 * once.after


def test_excitations_of_a_single_setting_have_offspring():
    step = Excitation(
        "step", {"height": Setting(0.1, 2.0)}, lambda s: np.full((100, 1), s["height"]), DT
    )
    for seed in range(3):
        result = design(lag(), [step], noise=NOISE, seed=seed, **(QUICK | {"offspring": 12}))
        assert result.runs[0].settings["height"] == pytest.approx(2.0, rel=0.1)


def test_parts_of_a_value_that_is_zero_are_refused_by_its_name():
    rest = Parameter("rest", "m", 0.0, -1.0, 1.0, minimum=-2.0)
    model = replace(
        lag().with_parameters(b={"fixed": True}),
        parameters=(*lag().with_parameters(b={"fixed": True}).parameters, rest),
        derivative=lambda x, u, p: ((p[0] * p[1] * u[0] + p[3] - x[0]) / p[2],),
    )
    with pytest.raises(ModelError, match="rest: a design tells intervals in parts of values"):
        design(model, [SQUARE], noise=NOISE, precision=0.05, **QUICK)
