"""C of a controller, compiled, against Python: the law, and the model's step."""

import shutil
import subprocess

import numpy as np
import pytest
import yaml

from daq.lookup.controllers import load_controller
from sysid import Stepper
from tests.daq.support import rig
from tests.haptics.test_laws import samples
from tests.haptics.test_torque_tracking import controller

CC = shutil.which("gcc")
FULL_SCALE = np.array([4.04, 0.36])  # V, largest of the commands
MAIN = """
#include <stdio.h>
#include "NAME.h"
int main(void)
{
    static rig_controller law;
    static rig_model model;
    double theta, omega, torque, i_m, reference;
    int lost;
    rig_controller_reset(&law);
    rig_model_reset(&model);
    while (scanf("%lf %lf %lf %lf %lf %d", &theta, &omega, &torque, &i_m, &reference, &lost) == 6) {
        rig_controller_step(&law, theta, omega, torque, i_m, reference, lost);
        rig_model_step(&model, 0.1 * law.volts[0], law.volts[1], 0.0);
        printf("%.17g %.17g %.17g %.17g\\n", (double)law.volts[0], (double)law.volts[1],
            (double)model.x[OMEGA], (double)model.x[Z]);
    }
    return 0;
}
"""


def rows():
    """What a controller is asked, (n, 6): sample, reference, samples lost."""
    tick = -1
    for sample in samples():
        lost, tick = sample.tick - tick - 1 if tick >= 0 else 0, sample.tick
        yield sample, 0.2 * np.sin(20.0 * sample.time), lost


def answers(folder, name, precision, model):
    """Commands [V], speed and hysteresis that the compiled program gives, (n, 4)."""
    done = rig("export", "c", f"{name}.yaml", "--precision", precision, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    places = {f"x[{key.upper()}]": f"x[{model.state_names.index(key)}]" for key in ("omega", "z")}
    main = MAIN.replace("NAME", name)
    for key, place in places.items():
        main = main.replace(key, place)
    (folder / "main.c").write_text(main)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1"]
    subprocess.run([CC, *flags, f"{name}.c", "main.c", "-lm", "-o", "law"], cwd=folder, check=True)
    lines = [
        " ".join(
            f"{v:.17g}" for v in (s.theta, s.omega, s.torque, s.current_motor, reference, lost)
        )
        for s, reference, lost in rows()
    ]
    text = "\n".join(lines)
    done = subprocess.run(
        ["./law"], cwd=folder, input=text, capture_output=True, text=True, check=True
    )
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)


@pytest.mark.skipif(CC is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("kind", "precision", "error"),
    [
        ("static", "double", 1e-6),
        ("feedforward", "double", 1e-6),
        ("lqg", "double", 1e-6),
        ("feedforward", "single", 1e-3),
        ("lqg", "single", 1e-3),
    ],
)
def test_c_answers_as_python_does(tmp_path, kind, precision, error):
    tuned = load_controller(str(controller(tmp_path, kind)), tmp_path)
    law, model = tuned.law(), tuned.model
    given = answers(tmp_path, kind, precision, model)
    volts = np.array([law.volts(sample, reference) for sample, reference, _ in rows()])
    assert np.abs(volts).max() > 1.0
    assert np.abs((given[:, :2] - volts) / FULL_SCALE).max() < error
    # The model, by the project's own integrator, at the commands that C gave.
    inputs = np.column_stack([given[:, :2] * [0.1, 1.0], np.zeros(len(given))])
    stepper = Stepper(model, tuned.parameters, 1.0 / 800.0, n_steps=1, accuracy=1e-9)
    x = model.initial_state
    states, _ = stepper.advance(x, np.vstack([inputs, inputs[-1:]]))
    speed, z = (states[1:, model.state_names.index(name)] for name in ("omega", "z"))
    assert np.abs(given[:-1, 2] - speed).max() < 1e-3 * np.abs(speed).max()
    assert np.abs(given[:-1, 3] - z).max() < 2e-3


def test_what_is_no_controller_is_refused(tmp_path):
    (tmp_path / "c.yaml").write_text(yaml.safe_dump({"controller": "feedforward"}))
    done = rig("export", "c", "c.yaml", cwd=tmp_path)
    assert done.returncode == 2 and "make it anew with rig tune" in done.stderr
