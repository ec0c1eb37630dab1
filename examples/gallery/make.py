"""Data, results and the figure of the gallery, from the models' own true values.

python make.py          writes SYSTEM_training.csv and SYSTEM_validation.csv here, then the README
rig identify two_tanks_training.csv --validate two_tanks_validation.csv --config two_tanks.yaml
"""

import importlib
from pathlib import Path

import numpy as np

from sysid import BatchSimulator, Dataset

SYSTEMS = ("two_tanks", "oscillator", "aeropendulum", "air_vessel", "heater", "battery")
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


def main():
    """Write the data, identify every system, and write the README's table and figure."""
    import matplotlib.pyplot as plt

    from daq import identify

    hits = []
    lines = ["| system | parameter | true | found | 95 % interval |", "|---|---|---|---|---|"]
    figure, axes = plt.subplots(3, 2, figsize=(9.0, 7.5), layout="constrained")
    for name, axis in zip(SYSTEMS, axes.flat, strict=True):
        module = system(name)
        files = [HERE / f"{name}_{part}.csv" for part in ("training", "validation")]
        for file, samples, seed in zip(files, (2000, 1000), (1, 2), strict=True):
            save(module, record(module, samples, seed), file)
        result = identify(files[0], files[1], config=HERE / f"{name}.yaml")
        label = f"[`{name}`]({name}.py)"
        for row in result.rows.parameters:
            truth, (low, high) = module.TRUTH[row.name], row.interval
            numbers = f"{truth:.4g} | {row.text(row.value)} | {row.span()} {row.unit}"
            lines.append(f"| {label} | `{row.name}` | {numbers} |")
            hits.append(low <= truth <= high)
            label = ""
        log, output = result.validation[0], module.model.outputs[-1]
        data, fit = log.log.dataset, result.metrics["fit_percent"].iloc[-1]
        axis.plot(data.time, data.outputs[:, -1], color="0.6", lw=2.5, label="measured")
        axis.plot(data.time, log.run[:, -1], color="#D55E00", lw=0.9, label="identified")
        axis.set(title=f"{name}: fit {fit:.1f} %", xlabel="t [s]")
        axis.set_ylabel(f"{output.name} [{output.unit}]")
        print(f"{name}: fit {fit:.2f} %, {result.trust}")
    axes[0, 0].legend()
    figure.savefig(HERE / "gallery.png", dpi=110)
    lines += ["", f"{sum(hits)} of {len(hits)} intervals hold the true value."]
    readme = HERE / "README.md"
    parts = readme.read_text().split(MARK)
    readme.write_text(MARK.join([parts[0], "\n".join(lines) + "\n", parts[2]]))


if __name__ == "__main__":
    main()
