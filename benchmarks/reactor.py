"""A designed experiment beside Pyomo.DoE's, on its published example under equal constraints.

python -m benchmarks.reactor [--json] [--seeds 5]

A -> B -> C in a batch for an hour; the temperature is free between 300 and 700 K for each eighth of
it, the first concentration between 1 and 5 mol/L. Concentrations of all three are measured every
eighth to 0.01 mol/L; what is wanted are both reactions' rates and activation energies (Wang and
Dowling, "Pyomo.DOE", AIChE Journal 68, 2022). Figures: log10 of the determinant of Fisher's matrix,
by relative parameters, of both designs by our tangents, and seconds. Pyomo, and ipopt for it, have
to be installed; without them only this project's design is shown.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, timed
from sysid import (
    BatchSimulator,
    Dataset,
    Excitation,
    Input,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    Setting,
    State,
    design,
)
from sysid.arrays import FloatArray
from sysid.experiments.information import Informant

EIGHTH = 0.125  # h
PERIODS = 8
FEED, TEMPERATURE = (1.0, 5.0), (300.0, 700.0)  # mol/L, K
NOISE = 0.01  # mol/L
TRUTH = {"A1": 84.79, "E1": 7.78, "A2": 371.72, "E2": 15.05}
GAS_CONSTANT = 8.314e-3  # kJ/(mol K)
ACCURACY = 1e-6


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=5, help="of the design's search")
    options = parser.parse_args()
    first, _ = timed(lambda: designed(0))  # compiles
    searches = [timed(lambda seed=seed: designed(seed)) for seed in range(options.seeds)]
    found = [figures_of(inputs) for _, inputs in searches]
    found.sort(key=lambda each: each["log10_determinant"])
    figures: dict[str, Any] = {
        "here": {
            "first": first,
            "seconds": float(np.median([seconds for seconds, _ in searches])),
            "log10_determinants": [each["log10_determinant"] for each in found],
            **found[len(found) // 2],
        }
    }
    if shutil.which("ipopt") and (there := pyomo_design()) is not None:
        figures["pyomo"] = there
    report(figures, options.json, show)


def reactor() -> ProcessModel:
    """A and B in parts of the first concentration, which is an input as the temperature is."""

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        a, b = x
        temperature, (rate_1, energy_1, rate_2, energy_2) = max(u[0], TEMPERATURE[0]), p
        first = rate_1 * math.exp(-energy_1 / (GAS_CONSTANT * temperature)) * a
        second = rate_2 * math.exp(-energy_2 / (GAS_CONSTANT * temperature)) * b
        return (-first, first - second)

    def output(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        a, b = x
        return (u[1] * a, u[1] * b, u[1] * (1.0 - a - b))

    units = {"A": "1/h", "E": "kJ/mol"}
    return ProcessModel(
        name="reactor",
        states=(State("a", "1", initial=1.0), State("b", "1", initial=0.0)),
        inputs=(Input("temperature", "K"), Input("feed", "mol/L")),
        outputs=tuple(Output(name, "mol/L") for name in ("CA", "CB", "CC")),
        parameters=tuple(
            Parameter(name, units[name[0]], value, value / 1e3, value * 1e3, "log")
            for name, value in TRUTH.items()
        ),
        derivative=derivative,
        output=output,
    )


def batch() -> Excitation:
    def inputs(s: Mapping[str, float]) -> FloatArray:
        temperature = [s[f"T{k}"] for k in range(PERIODS)]
        return signal(s["feed"], [*temperature, temperature[-1]])

    settings = {"feed": Setting(*FEED), **{f"T{k}": Setting(*TEMPERATURE) for k in range(PERIODS)}}
    return Excitation("batch", settings, inputs, EIGHTH)


def signal(feed: float, temperature: list[float]) -> FloatArray:
    return np.column_stack([temperature, np.full(len(temperature), feed)])


def designed(seed: int) -> FloatArray:
    """Inputs of the best batch found, (9, 2)."""
    noise = dict.fromkeys(("CA", "CB", "CC"), NOISE)
    size: dict[str, Any] = {"generations": 24, "offspring": 96}
    found = design(reactor(), [batch()], noise=noise, runs=1, draws=1, checks=1, seed=seed, **size)
    return found.runs[0].inputs


def figures_of(inputs: FloatArray) -> dict[str, Any]:
    """A batch, and log10 of the determinant of its information."""
    model = reactor()
    informant = Informant(
        BatchSimulator(model, accuracy=ACCURACY),
        SearchSpace.of(model),
        np.full(3, NOISE),
        np.zeros(2),
    )
    record = Dataset(inputs, np.full((len(inputs), 3), np.nan), EIGHTH)
    information = informant.information(record, model.nominal[None])[0]
    return {
        "feed": float(inputs[0, 1]),
        "temperature": inputs[:, 0].tolist(),
        "log10_determinant": float(np.linalg.slogdet(information)[1] / math.log(10.0)),
    }


def pyomo_design() -> dict[str, Any] | None:
    """Pyomo's design from the start of its own example; None where it is not installed."""
    try:
        from pyomo.contrib.doe import DesignOfExperiments
        from pyomo.contrib.doe.examples.reactor_experiment import ReactorExperiment
    except ImportError:
        return None
    points = {EIGHTH * k: 500.0 if k == 0 else 300.0 for k in range(PERIODS + 1)}
    data = {
        "CA0": 5.0, "CB0": 0.0, "CC0": 0.0, "CA_bounds": list(FEED), "T_bounds": list(TEMPERATURE),
        "t_range": [0, 1], "control_points": points, **TRUTH,
    }  # fmt: skip
    doe = DesignOfExperiments(
        ReactorExperiment(data, nfe=10, ncp=3), scale_nominal_param_value=True, step=1e-3
    )
    seconds, _ = timed(doe.run_doe)
    feed, *temperature = doe.results["Experiment Design"]
    own = np.linalg.slogdet(np.array(doe.results["FIM"], dtype=np.float64))[1] / math.log(10.0)
    return {
        "seconds": seconds,
        "by_its_own": float(own),
        **figures_of(signal(feed, temperature)),
    }


def show(figures: dict[str, Any]) -> None:
    for name, row in figures.items():
        if name == "machine":
            continue
        temperature = ", ".join(f"{value:.0f}" for value in row["temperature"])
        first = f" ({row['first']:.1f} s the first time)" if "first" in row else ""
        print(f"\n{name}: {row['seconds']:.1f} s{first}")
        print(f"  feed {row['feed']:.3f} mol/L, {temperature} K")
        own = f", by its own {row['by_its_own']:.3f}" if "by_its_own" in row else ""
        print(f"  log10 of the determinant {row['log10_determinant']:.3f}{own}")
        if "log10_determinants" in row:
            every = ", ".join(f"{value:.3f}" for value in row["log10_determinants"])
            print(f"  the median of {every}")
    if "pyomo" not in figures:
        print("\nPyomo and ipopt are not installed: no comparison.")
        return
    gain = figures["here"]["log10_determinant"] - figures["pyomo"]["log10_determinant"]
    faster = figures["pyomo"]["seconds"] / figures["here"]["seconds"]
    print(f"\nOur determinant is 10^{gain:.3f} times Pyomo's, in 1/{faster:.2g} of its time.")


if __name__ == "__main__":
    main()
