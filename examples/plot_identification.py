"""Draw measured against identified outputs of a capture (needs matplotlib).

python plot_identification.py runs/<validation run> runs/<run>/identification/parameters.yaml
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from daq.cli import datasets
from daq.cli.replaying import read_parameters
from sysid import BatchSimulator, evaluate, free_run

MEASURED, IDENTIFIED = "#4d4d4d", "#d55e00"  # distinguishable without colour vision


def draw(capture: Path, parameters: Path, picture: Path) -> None:
    """One panel per output: the log's samples and the free-run simulation over them."""
    model, values = read_parameters(parameters)
    data = datasets.load(capture, model, None).dataset
    simulated = free_run(BatchSimulator(model), model.vector(values), data)
    fits = evaluate(data.outputs, simulated).fit
    figure, panels = plt.subplots(
        len(model.outputs), 1, sharex=True, figsize=(7.0, 4.6), layout="constrained"
    )
    for j, (output, panel) in enumerate(zip(model.outputs, panels, strict=True)):
        panel.plot(data.time, data.outputs[:, j], color=MEASURED, lw=1.6, label="measured")
        panel.plot(data.time, simulated[:, j], color=IDENTIFIED, lw=0.9, label="identified")
        panel.set_ylabel(f"{output.name.replace('_', ' ')}\n[{output.unit}]")
        panel.set_title(f"fit {fits[j]:.1f} %", loc="right", fontsize="small")
        panel.grid(alpha=0.25)
    panels[0].legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
    panels[-1].set_xlabel("time [s]")
    figure.savefig(picture, dpi=150)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]), Path("identification.png"))
