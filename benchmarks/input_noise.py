"""What noise of the measured torque does to parameters, by each criterion.

python -m benchmarks.input_noise [--json] [--seeds 40] [--exact-sensors]

The shipped experiment on the simulated rig, a new seed of noise and offsets each time, fitted from
the true values, so that the minimum is the right one: bias and coverage of what the torque's noise
moves most, and the time of the fit's last step. With ``--exact-sensors`` the records are the
model's own, with white noise on every output in place of converters and encoder, in pairs of
opposite sign: of their mean only biases are left.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks._common import arguments, report, simulated_logs
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.fitting.objective import Objective
from sysid.gassi.likelihood import fit_likelihood
from sysid.problem.model import ProcessModel
from sysid.problem.space import SearchSpace
from sysid.uncertainty import Estimate, uncertainty

CRITERIA = ("likelihood", "compensated", "innovations")
QUANTITIES = ("J_m + J_b", "A alpha0", "A alpha1", "K_m", "gamma")
_HYSTERESIS_START = -1.1  # where the wound load leaves z
_NOISE = np.array([0.005, 0.005, 0.1])  # A, A, rad/s


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=40, help="of noise")
    parser.add_argument("--exact-sensors", action="store_true", help="white noise in pairs")
    options = parser.parse_args()
    model = actuator()
    truth: FloatArray = actuator(parameters="rig").nominal
    records = paired_records(model, truth) if options.exact_sensors else rig_records(model)
    chosen = [record for _, record in zip(range(options.seeds), records, strict=False)]
    report({"criteria": compare(model, truth, chosen)}, options.json, show)


def rig_records(model: ProcessModel) -> Iterator[Dataset]:
    """The shipped experiment's training logs, a seed each."""
    seed = 0
    while True:
        yield simulated_logs(model, seed)[0]
        seed += 1


def paired_records(model: ProcessModel, truth: FloatArray) -> Iterator[Dataset]:
    """The model's own outputs with noise of one sign, then of the other."""
    measured = simulated_logs(model)[0]
    start = measured.initial_state(model)
    start[model.state_names.index("z")] = _HYSTERESIS_START
    simulator = BatchSimulator(model, accuracy=1e-7)
    exact = simulator.trajectories(truth, measured, starts=start[None])[0]
    seed = 0
    while True:
        rng = np.random.default_rng(seed)
        of_outputs = _NOISE * rng.standard_normal(exact.shape)
        of_inputs = measured.input_noise * rng.standard_normal(measured.inputs.shape)
        of_outputs[0] = 0.0
        for sign in (1.0, -1.0):
            inputs, outputs = measured.inputs + sign * of_inputs, exact + sign * of_outputs
            yield Dataset(inputs, outputs, measured.dt, input_noise=measured.input_noise)
        seed += 1


def compare(
    model: ProcessModel, truth: FloatArray, records: list[Dataset]
) -> dict[str, dict[str, Any]]:
    """Bias, scatter and coverage of the quantities, and seconds of a fit, by criterion."""
    values = dict(zip(model.parameter_names, truth.tolist(), strict=True))
    logarithms: dict[str, dict[str, list[float]]] = {c: defaultdict(list) for c in CRITERIA}
    held: dict[str, dict[str, list[bool]]] = {c: defaultdict(list) for c in CRITERIA}
    seconds: dict[str, list[float]] = defaultdict(list)
    for record in records:
        space = SearchSpace.of(model).with_starts([record])
        objective = Objective(BatchSimulator(model), space, [record])
        start = space.with_nominal_starts(truth[list(space.index)])
        start[-1] = _HYSTERESIS_START
        for criterion in CRITERIA:
            begun = time.perf_counter()
            noise = None if criterion == "likelihood" else criterion
            best = fit_likelihood(objective, [start], noise=noise).optimum  # type: ignore[arg-type]
            seconds[criterion].append(time.perf_counter() - begun)
            for estimate in uncertainty(best.objective, best.chromosome).determined():
                if estimate.name in QUANTITIES:
                    logarithm, inside = _judged(estimate, values)
                    logarithms[criterion][estimate.name].append(logarithm)
                    held[criterion][estimate.name].append(inside)
    return {
        criterion: {
            "seconds": float(np.median(seconds[criterion])),
            "quantities": {
                name: {
                    "intervals": len(errors),
                    "bias": float(np.mean(errors)),
                    "deviation": float(np.std(errors)),
                    "coverage": float(np.mean(held[criterion][name])),
                }
                for name, errors in logarithms[criterion].items()
            },
        }
        for criterion in CRITERIA
    }


def _judged(estimate: Estimate, truth: dict[str, float]) -> tuple[float, bool]:
    """Logarithm of an estimate over the truth, and whether its interval holds that."""
    value = estimate.at(truth)
    assert estimate.low is not None and estimate.high is not None
    return float(np.log(estimate.value / value)), bool(estimate.low <= value <= estimate.high)


def show(figures: dict[str, Any]) -> None:
    for criterion, row in figures["criteria"].items():
        print(f"\n{criterion}: {row['seconds']:.2f} s for the last step of a fit")
        for name, q in row["quantities"].items():
            error = q["deviation"] / np.sqrt(q["intervals"])
            print(
                f"  {name:<10} {q['intervals']:3d} intervals, bias {100 * q['bias']:5.1f} "
                f"+- {100 * error:.1f} %, deviation {100 * q['deviation']:4.1f} %, "
                f"{100 * q['coverage']:5.1f} % hold the truth"
            )


if __name__ == "__main__":
    main()
