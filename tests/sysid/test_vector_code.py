"""What the compiler makes of lanes: instructions on vectors, not on one number after the other."""

import platform
import re

import numpy as np
import pytest

from sysid import BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.engine import compiler
from sysid.engine.filter_settings import FilterSettings
from sysid.engine.intervals import Intervals

DT, N = 0.02, 40
# Of x86: multiplications and sums of two, four or eight doubles, and of one.
_ARITHMETIC = re.compile(r"^\s+v?(?:mul|add|sub|fn?m(?:add|sub)\d+)(pd|sd)\b", re.MULTILINE)


def hardening_spring():
    """A model whose kernels nothing has compiled yet: its function is one of its own."""
    return ProcessModel(
        "hardening spring",
        (State("angle", "rad"), State("speed", "rad/s")),
        (Input("torque", "N*m", "foh"),),
        (Output("angle", "rad"), Output("speed", "rad/s")),
        (Parameter("k", "1/s^2", 40.0, 10.0, 90.0), Parameter("d", "1/s", 2.0, 0.5, 8.0)),
        lambda x, u, p: (x[1], u[0] - p[0] * x[0] - p[1] * x[1] - 3.0 * abs(x[1]) * x[1]),
    )


@pytest.fixture
def compiled(monkeypatch):
    """Functions that are compiled, none of them loaded."""
    made, compile_function = {}, compiler._njit

    def anew(function, *, cache=False, **options):
        made[function.__name__] = dispatcher = compile_function(function, **options)
        return dispatcher

    monkeypatch.setattr(compiler, "_njit", anew)
    return made


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="instructions of x86")
@pytest.mark.parametrize("function", ["simulate", "innovations", "advance"])
def test_lanes_are_worked_out_by_vectors(compiled, function):
    model, rng = hardening_spring(), np.random.default_rng(0)
    u, y = rng.standard_normal((N, 1)), rng.standard_normal((N, 2))
    windows = np.zeros((N, 2, 2))
    windows[:, 1, 0] = -DT
    record = Dataset(u, y, DT, input_noise=np.array([0.1]), windows=windows)
    if function == "advance":
        intervals = Intervals(model, model.nominal, u, DT, 2)
        intervals.run(model.initial_state)
    else:
        parameters, scales = model.nominal[None], [np.ones(2)]
        simulator, steps = BatchSimulator(model), np.array([[2]])
        simulator.residuals(parameters, [record], scales, steps, [None])
        settings = [FilterSettings(np.array([0.1, 0.2]))]
        simulator.innovations(parameters, [record], scales, steps, [None], settings)
    (assembly,) = compiled[function].inspect_asm().values()
    packed, single = (_ARITHMETIC.findall(assembly).count(kind) for kind in ("pd", "sd"))
    # What parameters fix is worked out once, lane by lane.
    assert single < packed, (single, packed)
