"""Runs in closed loop: inputs that answer the outputs, in designs too."""

import numpy as np
import pytest

from sysid import Excitation, Feedback, ModelError, Setting, Stepper, design
from sysid.engine.simulation import BatchSimulator
from sysid.examples import lag
from sysid.experiments.bench import FreeRun

DT, AHEAD = 0.01, 2


def proportional(reference, gain, n_samples=300, ahead=AHEAD):
    """u = gain (reference - y)."""
    return Feedback(lambda: lambda y: gain * (reference - y), n_samples, ahead)


def recursion(reference, gain, dc_gain, tau, n, ahead=AHEAD):
    """The same loop around a lag with a held input, sample by sample in closed form."""
    decay, y, u = np.exp(-DT / tau), np.zeros(n), np.zeros(n)
    for k in range(n):
        if k >= ahead:
            u[k] = gain * (reference - y[k - ahead])
        if k + 1 < n:
            y[k + 1] = decay * y[k] + (1.0 - decay) * dc_gain * u[k]
    return u, y


@pytest.mark.parametrize("ahead", [1, 3])
def test_a_loop_around_a_lag_is_that_of_its_recursion(ahead):
    inputs, outputs = proportional(1.5, 2.0, ahead=ahead).run(
        Stepper(lag(), np.array([3.0, 0.2]), DT, accuracy=1e-9)
    )
    u, y = recursion(1.5, 2.0, 3.0, 0.2, 300, ahead)
    assert inputs[:, 0] == pytest.approx(u, abs=1e-7)
    assert outputs[:, 0] == pytest.approx(y, abs=1e-7)


def test_each_run_has_a_controller_of_its_own_that_may_end_it():
    def begin():
        seen = []

        def answer(y):
            seen.append(y)
            return None if len(seen) == 40 else np.ones(1)

        return answer

    feedback, stepper = Feedback(begin, 300), Stepper(lag(), np.array([3.0, 0.2]), DT)
    lengths = [len(feedback.run(stepper)[0]) for _ in range(2)]
    assert lengths == [40, 40]


@pytest.mark.parametrize("answer", [np.ones(2), np.array([np.nan]), 1.0])
def test_what_is_no_answer_is_refused(answer):
    with pytest.raises(ModelError, match=r"answer with 1 finite numbers"):
        Feedback(lambda: lambda y: answer, 10).run(Stepper(lag(), np.array([3.0, 0.2]), DT))


def test_a_run_that_ends_at_once_is_refused():
    with pytest.raises(ModelError, match="first sample"):
        Feedback(lambda: lambda y: None, 10).run(Stepper(lag(), np.array([3.0, 0.2]), DT))


def test_each_vector_has_the_inputs_that_answer_it():
    bench = FreeRun(BatchSimulator(lag()), {"y": (-2.0, 2.0)}, margin=0.0)
    vectors = np.array([[3.0, 0.2], [6.0, 0.4]])
    records = bench.records(proportional(1.5, 2.0), DT, vectors)
    for record, (dc_gain, tau) in zip(records, vectors, strict=True):
        u, _ = recursion(1.5, 2.0, dc_gain, tau, 300)
        assert record.inputs[:, 0] == pytest.approx(u, abs=1e-4)
    strong = np.array([[3.0, 0.2], [60.0, 0.4]])  # overshoots
    assert bench.records(proportional(1.5, 2.0), DT, strong) is None


def servo(reference):
    return Excitation(
        "servo",
        {"reference": reference, "gain": Setting(0.2, 2.0, log=True)},
        lambda s: proportional(s["reference"], s["gain"]),
        DT,
    )


def test_a_design_keeps_limits_by_a_loop_whatever_the_parameters():
    """A lag of unknown gain: what an open loop may command then tells less."""
    limits, quick = {"y": (-2.0, 2.0)}, {"runs": 2, "candidates": 24, "generations": 2, "draws": 2}
    wide = {"gain": (0.5, 40.0)}
    step = Excitation(
        "step", {"height": Setting(0.0, 2.0)}, lambda s: np.full((300, 1), s["height"]), DT
    )
    shared = {"noise": {"y": 0.01}, "limits": limits, "ranges": wide, **quick}
    closed = design(lag(), [step, servo(Setting(0.0, 2.0))], **shared)
    opened = design(lag(), [step], **shared)
    assert {run.excitation for run in closed.runs} == {"servo"}
    assert closed.duration == pytest.approx(6.0)
    for looped, free in zip(closed.quantities, opened.quantities, strict=True):
        assert looped.after < 0.7 * free.after, looped.name


def test_runs_that_some_parameters_would_take_beyond_limits_are_not_chosen(monkeypatch):
    """All of the checks are asked before a loop is chosen, if not while it is looked for."""
    monkeypatch.setattr("sysid.experiments.experiment.available_cores", lambda: 1)
    asked = []

    class Counting(FreeRun):
        def records(self, inputs, dt, vectors):
            if isinstance(inputs, Feedback):
                asked.append(len(vectors))
                if len(vectors) == 9 and asked.count(9) == 1:
                    return None
            return super().records(inputs, dt, vectors)

    bench = Counting(BatchSimulator(lag(), threads=1))
    quick = {"noise": {"y": 0.01}, "runs": 2, "candidates": 12, "generations": 1, "checks": 9}
    result = design(lag(), [servo(Setting(0.5, 2.0))], bench=bench, **quick)
    assert set(asked) == {4, 9} and asked.count(9) >= 2
    assert result.refused == 1 and len(result.runs) == 2

    class Refusing(FreeRun):
        def records(self, inputs, dt, vectors):
            return super().records(inputs, dt, vectors) if len(vectors) == 4 else None

    with pytest.raises(ModelError, match="each of 12 runs that were tried would pass a limit"):
        design(lag(), [servo(Setting(0.5, 2.0))], bench=Refusing(BatchSimulator(lag())), **quick)
