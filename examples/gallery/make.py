"""Data, results and the figure of the gallery, from the models' own true values.

python make.py          writes SYSTEM_training.csv and SYSTEM_validation.csv here, then the README's
                        table and gallery.png; a minute or two
rig identify two_tanks_training.csv --validate two_tanks_validation.csv --config two_tanks.yaml
"""

import argparse
import importlib
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from sysid import BatchSimulator, Dataset

SYSTEMS = (
    "two_tanks",
    "oscillator",
    "aeropendulum",
    "air_vessel",
    "heater",
    "battery",
    "elastic_shaft",
    "quarter_car",
    "reactor",
)
HERE = Path(__file__).parent
NOISE = 0.005  # of the largest output
MARK = "<!-- made by make.py -->\n"


def system(name):
    """A system's module."""
    return importlib.import_module(name)


def record(module, samples, seed):
    """Random levels of the input, each held for a while, and the answer to them with noise."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(*module.LEVELS, samples // module.HOLD + 1)
    inputs = np.repeat(levels, module.HOLD)[:samples, None]
    model = module.model
    blank = Dataset(inputs, np.zeros((samples, len(model.outputs))), module.SAMPLE_TIME)
    truth = model.vector(module.TRUTH)
    # From the model's own start, whatever was measured.
    outputs = BatchSimulator(from_rest(model), accuracy=1e-9).trajectories(truth, blank)[0]
    size = np.abs(outputs - outputs.mean(axis=0)).max(axis=0)
    outputs = outputs + NOISE * size * rng.standard_normal(outputs.shape)
    return Dataset(inputs, outputs, module.SAMPLE_TIME, model.name)


def from_rest(model):
    """The model with every state where it declares, not where the first sample is."""
    return model.with_initial({state.name: state.initial for state in model.states})


def save(module, data, path):
    """A record as a table with the signals' names."""
    model = module.model
    head = ",".join(("t", *model.input_names, *model.output_names))
    table = np.column_stack([data.time, data.inputs, data.outputs])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")


def of_gallery(name):
    """The identification of one of SYSTEMS from its record, and its true values."""
    module, files = system(name), files_of(name)
    for file, samples, seed in zip(files, (2000, 1000), (1, 2), strict=True):
        save(module, record(module, samples, seed), file)
    return identified(files, HERE / f"{name}.yaml"), module.TRUTH


def of_motor():
    """The same of the DC motor, with noise on its records, which have none."""
    examples, files = system("dc_motor_data"), files_of("dc_motor")
    rng = np.random.default_rng(1)
    for file, data in zip(files, (examples.training(), examples.validation()), strict=True):
        size = np.abs(data.outputs).max(axis=0)
        noisy = data.outputs + NOISE * size * rng.standard_normal(data.outputs.shape)
        save(system("dc_motor"), Dataset(data.inputs, noisy, data.dt), file)
    model = system("dc_motor").model
    truth = dict(zip(model.parameter_names, model.nominal, strict=True))
    return identified(files, HERE.parent / "dc_motor.yaml"), truth


def of_drive():
    """The same of the drive that sticks."""
    examples, files = system("friction_drive_data"), files_of("friction_drive")
    for file, rows in zip(files, (examples.training(), examples.validation()), strict=True):
        examples.save(file, rows)
    return identified(files, HERE.parent / "friction_drive.yaml"), examples.TRUTH


def of_actuator():
    """The same of the actuator, from two runs of the simulated rig."""
    from daq import identify
    from daq import record as run
    from sim_rig.actuator import actuator

    with tempfile.TemporaryDirectory() as folder:
        runs = [run("prbs.yaml", validation=held, out=folder) for held in (False, True)]
        result = identify(*runs, seed=0)
    model = actuator(parameters="rig")
    return result, dict(zip(model.parameter_names, model.nominal, strict=True))


def files_of(name):
    """Where a system's records are written."""
    return [HERE / f"{name}_{part}.csv" for part in ("training", "validation")]


def identified(files, config):
    """The identification of a training and a validation record."""
    from daq import identify

    return identify(*files, config=config)


def table_rows(link, result, truth):
    """Lines of the table, and of each interval whether it holds the true value."""
    lines, hits = [], []
    for row in result.rows.determined:
        low, high = row.interval
        numbers = f"{truth[row.name]:.4g} | {row.text(row.value)} | {row.span()} {row.unit}"
        lines.append(f"| {'' if lines else link} | `{row.name}` | {numbers} |")
        hits.append(low <= truth[row.name] <= high)
    return lines, hits


def draw(axis, name, result):
    """The last output over the validation record, and its fit in the title."""
    log, output = result.validation[0], result.model.outputs[-1]
    data, fit = log.log.dataset, log.result.metrics.fit[-1]
    axis.plot(data.time, data.outputs[:, -1], color="0.6", lw=2.5, label="measured")
    axis.plot(data.time, log.run[:, -1], color="#D55E00", lw=0.9, label="identified")
    axis.set(title=f"{name}: fit {fit:.1f} %", xlabel="t [s]")
    axis.set_ylabel(f"{output.name} [{output.unit}]")
    print(f"{name}: fit {fit:.2f} %, {result.trust}")


def main():
    """Write the data, identify every system, and write the README's table and figure."""
    formatter = argparse.RawDescriptionHelpFormatter
    argparse.ArgumentParser(description=__doc__, formatter_class=formatter).parse_args()
    import matplotlib.pyplot as plt

    sys.path.append(str(HERE.parent))
    cases = {
        "actuator": ("../../docs/actuator.md", of_actuator),
        "dc_motor": ("../dc_motor.py", of_motor),
        "friction_drive": ("../friction_drive.py", of_drive),
        **{name: (f"{name}.py", partial(of_gallery, name)) for name in SYSTEMS},
    }
    hits = []
    lines = ["| system | parameter | true | found | 95 % interval |", "|---|---|---|---|---|"]
    figure, axes = plt.subplots(4, 3, figsize=(12.0, 10.0), layout="constrained")
    for axis, (name, (place, make)) in zip(axes.flat, cases.items(), strict=True):
        result, truth = make()
        rows, held = table_rows(f"[`{name}`]({place})", result, truth)
        lines, hits = lines + rows, hits + held
        draw(axis, name, result)
    axes[0, 0].legend()
    figure.savefig(HERE / "gallery.png", dpi=110)
    lines += ["", f"{sum(hits)} of {len(hits)} intervals hold the true value."]
    readme = HERE / "README.md"
    parts = readme.read_text(encoding="utf-8").split(MARK)
    text = MARK.join([parts[0], "\n".join(lines) + "\n", parts[2]])
    readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
