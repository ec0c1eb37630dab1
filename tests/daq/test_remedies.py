"""Settings that take out what was found wrong, in the command that comes next."""

import pytest

from daq.config.identification import IdentificationConfig
from daq.identification.remedies import remedies
from sysid.judging.score_tests import Finding
from sysid.problem.faults import DataFault

COLUMNS = {
    "columns": {
        "time": {"column": "t"},
        "inputs": {"u": {"column": "u"}},
        "outputs": {"y": {"column": "y", "sign": -1}},
    }
}


def settings(**content):
    return IdentificationConfig.model_validate(content)


def found(kind, name, amplitude, share=0.5):
    return Finding(kind, name, "s", amplitude, 1e-12, share, ())


def fault(kind, severity="doubt", setting=""):
    return DataFault(kind, severity, "training", ("log",), "y", "", "", "", 0.1, setting=setting)


def mended(findings=(), faults=(), pushed=None, **content):
    return remedies(
        settings(**content), ("u", "y"), faults=faults, findings=findings, pushed=pushed
    )


def test_a_delay_is_added_to_what_is_taken_out_already():
    assert mended([found("delay", "y", 0.00412)]) == ("delay.y=0.00412",)
    late = [found("delay", "u", -0.002)]
    assert mended(late, delay={"u": "5 ms"}) == ("delay.u=0.003",)


def test_a_sign_is_turned_round_where_the_file_says_it():
    wrong = [found("gain", "y", -2.1), found("gain", "u", 0.3)]
    assert mended(wrong, **COLUMNS) == ("columns.outputs.y.sign=1",)
    assert mended(wrong) == ()


def test_what_counts_little_or_is_of_a_single_log_is_left_alone():
    assert mended([found("delay", "y", 1e-4, share=0.01)]) == ()
    assert mended([found("delay", "y of training 2", 0.004)]) == ()


def test_faults_of_samples_come_first_and_a_lag_is_taken_out_once():
    late = fault("lag", setting="delay.y=0.004")
    jolts = fault("outliers", setting="robust=true")
    assert mended([found("delay", "u", 0.001)], [jolts, late]) == (
        "robust=true",
        "delay.y=0.004",
    )
    assert mended(faults=[fault("outliers", "note", "robust=true")]) == ()


@pytest.mark.parametrize(("value", "ends"), [(1e-5, "[1e-6, 0.001]"), (1e-3, "[1e-5, 0.01]")])
def test_a_range_whose_end_decides_is_widened_there_once_the_data_are_right(value, ends):
    pushed = {"J": (value, 1e-5, 1e-3)}
    assert mended(pushed=pushed) == (f"ranges.J={ends}",)
    jolts = fault("outliers", setting="robust=true")
    assert mended(faults=[jolts], pushed=pushed) == ("robust=true",)
