"""An identification that has the logs of an earlier one and more begins where that one ended."""

from dataclasses import replace

import pytest

from daq import record
from daq.identification import fit as use_case
from daq.identification.earlier_fit import EarlierFit
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.progress import Note
from sysid import EarlierMinima
from tests.daq.support import few_free, write_experiment, write_yaml

ANEW = "the logs together want other parameters than before: a search begins"


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A problem of two free parameters, two logs, and what the first of them tells."""
    folder = tmp_path_factory.mktemp("start")
    config = write_yaml(folder / "few.yaml", few_free("R_m", "K_m"))
    problem = problem_of(SettingsRequest(str(config), {"model": "actuator"}))
    long = {"duration": 1.25, "calibration": {"samples": 3200}}  # so that its noise is known
    experiments = [
        write_experiment(folder / f"{seed}.yaml", motor={"seed": seed}, **long) for seed in (3, 4)
    ]
    logs = [
        record(file, out=folder / "runs", options={"seed": seed}).folder / "log.csv"
        for seed, file in enumerate(experiments)
    ]
    earlier = use_case.fit(problem, logs[:1], [], examine=lambda result: False)
    return problem, logs, earlier


def of(result):
    """Values and intervals of the parameters that are free."""
    estimates = result.uncertainty.parameters[:2]
    values = {estimate.name: estimate.value for estimate in estimates}
    return values, {e.name: (e.low, e.high) for e in estimates}


def identified(case, values=None, ends=None, *, settled=True):
    """The fit of both logs and its notes; values, ends: of an earlier fit, if any."""
    problem, logs, _ = case
    earlier = None
    if values is not None:
        noise = case[2].document["criterion"]["noise"]
        earlier = EarlierFit(EarlierMinima([values], noise, settled), ends)
    said = []
    result = use_case.fit(
        problem, logs, [], None, said.append, examine=lambda result: False, earlier=earlier
    )
    return result, [note.text for note in said if isinstance(note, Note)]


@pytest.fixture(scope="module")
def searched(case):
    """The fit of both logs by a search of its own."""
    return identified(case)[0]


@pytest.mark.soak
def test_it_comes_to_what_a_search_comes_to_without_one(case, searched):
    begun, notes = identified(case, *of(case[2]))
    assert ANEW not in notes
    assert begun.estimator.n_simulations_ < 0.5 * searched.estimator.n_simulations_
    for name, (low, high) in of(searched)[1].items():
        value = of(searched)[0][name]
        assert of(begun)[0][name] == pytest.approx(value, abs=0.1 * (high - low))
        assert of(begun)[1][name] == pytest.approx((low, high), rel=0.02)


@pytest.mark.soak
def test_a_start_that_all_logs_speak_against_leads_to_a_search(case, searched):
    values, ends = of(case[2])
    wrong = {name: (1.2 * low, 1.2 * high) for name, (low, high) in ends.items()}
    begun, notes = identified(case, {n: 1.2 * v for n, v in values.items()}, wrong)
    assert ANEW in notes
    for name, (low, high) in of(searched)[1].items():
        value = of(searched)[0][name]
        assert of(begun)[0][name] == pytest.approx(value, abs=0.1 * (high - low))


@pytest.mark.soak
def test_a_search_begins_as_well_where_the_logs_have_led_from_a_start_that_they_speak_against(
    case, monkeypatch
):
    values, ends = of(case[2])
    wrong = {name: (1.2 * low, 1.2 * high) for name, (low, high) in ends.items()}
    begun, searched = [], use_case._searched
    monkeypatch.setattr(
        use_case, "_searched", lambda *args: begun.append(args[-1]) or searched(*args)
    )
    start = {n: 1.2 * v for n, v in values.items()}
    identified(case, start, wrong)
    beside, anew = begun
    assert beside.is_settled and not anew.is_settled
    assert beside.values == [start] and anew.values[1:] == [start]
    for name, value in values.items():
        assert anew.values[0][name] == pytest.approx(value, rel=0.02)


def test_logs_at_odds_or_noisier_than_before_speak_against_a_start(case):
    values, ends = of(case[2])
    result, noise = case[2], case[2].document["criterion"]["noise"]
    earlier = EarlierFit(EarlierMinima([values], noise), ends)
    assert earlier.agrees(result)
    assert earlier.explains(values, noise, {})
    thrice = {**noise, "omega": 3.0 * noise["omega"]}
    assert not earlier.explains(values, thrice, {})
    assert earlier.explains(values, thrice, {"omega": thrice["omega"]})  # the least of these logs
    at_odds = replace(result, uncertainty=replace(result.uncertainty, disagreement=5.0))
    assert not earlier.agrees(at_odds)


def test_an_earlier_fit_that_left_something_open_is_among_the_starts_of_a_search(case, searched):
    begun, notes = identified(case, *of(case[2]), settled=False)
    assert ANEW not in notes
    assert begun.estimator.n_simulations_ > 0.5 * searched.estimator.n_simulations_
    assert begun.estimator.error_ <= searched.estimator.error_ * (1.0 + 1e-6)
