"""The page on the right model says what its records give."""

import pytest

from daq import identify
from tests.examples.conftest import EXAMPLES

FOLDER = EXAMPLES / "right_model"


@pytest.mark.soak
@pytest.mark.parametrize(
    ("case", "words", "settings", "cure"),
    [
        ("friction", "sign of omega", "shape: sign", None),  # whose cure takes half a minute
        ("late", "3 samples (0.006 s) later", "delay.omega=0.006", {"delay": {"omega": 0.006}}),
        ("clipped", "omega ends at 180 rad/s", "robust=true", {"robust": True}),
    ],
)
def test_what_is_wrong_is_told_and_its_cure_finds_the_truth(
    example, monkeypatch, tmp_path, case, words, settings, cure
):
    monkeypatch.syspath_prepend(str(FOLDER))
    cases = example("cases")
    files = [tmp_path / f"{case}.csv", tmp_path / f"{case}_check.csv"]
    for seed, file in enumerate(files, 1):
        cases.save(file, cases.record(seed, **cases.CASES[case]))
    wrong = identify(*files, config=FOLDER / "drive.yaml")
    assert wrong.verdict.parameters.trust == "limited"
    assert words in " ".join(wrong.verdict.parameters.reasons)
    inertia = wrong.parameters.loc["inertia"]
    assert inertia.value > 1.03 * cases.TRUTH["inertia"]
    assert settings in wrong.next_step.command
    if cure is None:
        return
    right = identify(*files, config=FOLDER / "drive.yaml", **cure)
    assert right.verdict.parameters.trust == "good"
    assert "nothing of the inputs is left" in right.verdict.predicted.reasons[0]
    for name in ("inertia", "viscous"):
        assert right.parameters.value[name] == pytest.approx(cases.TRUTH[name], rel=0.003)
