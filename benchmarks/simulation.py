"""One simulation of the actuator: ours beside what else a lab could use.

python -m benchmarks.simulation [--json] [--chromosomes 1000]

Seven states, 1000 samples at 800 Hz, held commands. Peers that are not installed
(`pip install -e ".[bench]"`), or a missing C compiler, are left out and named. Times are per
simulation on one core; errors are normalised RMS of the worst output against a tight solution.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._common import arguments, report
from sim_rig.actuator import actuator
from sysid import BatchSimulator, Dataset
from sysid._compile import kernels
from sysid.model import FloatArray, ProcessModel
from sysid.reference import simulate
from sysid.space import SearchSpace

SAMPLES, RATE = 1000, 800.0
TIGHT_STEPS = 256  # of the exponential scheme: within 1e-8 of DOP853 at 1e-10
PEER_SAMPLES = 100  # slow peers run the record's start; their time per sample is constant


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--chromosomes", type=int, default=1000, help="drawn from the box")
    options = parser.parse_args()
    model = actuator()
    record = excitation(model)
    table, missing = engines(model, record)
    figures = {
        "engines": table,
        "missing": missing,
        "box": box(model, record, options.chromosomes),
        "linearity": linearity(model),
    }
    report(figures, options.json, show)


def excitation(model: ProcessModel, samples: int = SAMPLES) -> Dataset:
    """PRBS-like held commands and a constant load."""
    rng = np.random.default_rng(4)
    motor = np.repeat(rng.choice([-0.65, 0.85], samples // 4 + 1), 4)[:samples]
    brake = np.repeat(rng.choice([0.0, 0.14], samples // 40 + 1), 40)[:samples]
    inputs = np.stack([motor, brake, np.full(samples, -0.012)], axis=1)
    blank = Dataset(inputs, np.zeros((samples, 3)), 1.0 / RATE)
    outputs = BatchSimulator(model).trajectories(model.nominal, blank, TIGHT_STEPS)[0]
    return Dataset(inputs, outputs, 1.0 / RATE)


def engines(model: ProcessModel, record: Dataset) -> tuple[list[dict[str, Any]], list[str]]:
    """Every engine on the nominal parameters: milliseconds, error, ratio to ours."""
    rows: list[dict[str, Any]] = []
    missing: list[str] = []
    candidates: list[tuple[str, Callable[[], tuple[float, FloatArray | None]]]] = [
        ("ours, accuracy 1e-3", lambda: _ours(model, record, 1e-3)),
        ("ours, accuracy 1e-5", lambda: _ours(model, record, 1e-5)),
        ("our lanes, RK4 x32", lambda: _ours_rk4(model, record)),
        ("C, explicit vectors, RK4 x32", lambda: _c_vectors(record, model)),
        ("SciPy LSODA, compiled derivative", lambda: _scipy(model, record, "LSODA", True)),
        ("SciPy Radau, compiled derivative", lambda: _scipy(model, record, "Radau", True)),
        ("SciPy Radau, Python derivative", lambda: _scipy(model, record, "Radau", False)),
        ("scikit-sundae CVODE BDF", lambda: _sundae(model, record)),
        ("CasADi CVODES", lambda: _casadi(model, record)),
        ("diffrax Tsit5", lambda: _diffrax(model, record)),
    ]
    for name, engine in candidates:
        try:
            seconds, outputs = engine()
        except (ImportError, FileNotFoundError) as error:
            missing.append(f"{name}: {error}")
            continue
        row = {"engine": name, "milliseconds": seconds * 1e3, "error": None}
        if outputs is not None:
            row["error"] = _error(outputs, record.outputs[: len(outputs)])
        rows.append(row)
    for row in rows:
        row["ratio"] = row["milliseconds"] / rows[0]["milliseconds"]
    return rows, missing


def box(model: ProcessModel, record: Dataset, n: int) -> dict[str, Any]:
    """Distribution of the error over chromosomes drawn from the shipped ranges."""
    space = SearchSpace.of(model)
    low, high = space.encode(np.stack([space.lower, space.upper]))
    drawn = space.full(space.decode(np.random.default_rng(11).uniform(low, high, (n, len(low)))))
    simulator = BatchSimulator(model)
    tight = simulator.trajectories(drawn, record, TIGHT_STEPS)
    errors = np.empty(n)
    for i in range(n):
        # Each against its own tight solution: the residual is then the integration error.
        own = Dataset(record.inputs, tight[i], record.dt)
        scale = np.abs(tight[i]).max(axis=0)
        result = simulator.errors(drawn[i : i + 1], [own], [scale])
        errors[i] = np.sqrt(result.sse[0, 0].max() / record.n_samples)
    start = time.process_time()
    whole = simulator.errors(drawn, [record])
    seconds = time.process_time() - start
    feasible = np.all(space.violations(drawn[:, list(space.index)]) <= 0.0, axis=1)
    worst = np.argsort(np.where(feasible, errors, 0.0))[::-1][:5]
    return {
        "chromosomes": n,
        "cpu_milliseconds_each": seconds / n * 1e3,
        "mean_steps_per_sample": float(whole.steps.mean() / (record.n_samples - 1)),
        "median_error": float(np.median(errors)),
        "p99_error": float(np.percentile(errors, 99)),
        "share_above_1e-3": float(np.mean(~(errors < 1e-3))),
        # Outside the constraints the hysteresis may feed energy: chaos, for which no step size
        # gives one right answer.
        "feasible": int(feasible.sum()),
        "feasible_share_above_1e-3": float(np.mean(~(errors[feasible] < 1e-3))),
        "share_flagged": float(np.mean(whole.status != 0)),
        "worst": [
            {
                "error": float(errors[i]),
                "fastest_rate": float(_fastest(model, drawn[i])),
            }
            for i in worst
        ],
    }


def linearity(model: ProcessModel) -> list[dict[str, float]]:
    """Cost against samples and chromosomes: CPU microseconds per sample and chromosome."""
    rows = []
    simulator = BatchSimulator(model)
    for samples, chromosomes in ((500, 320), (1000, 320), (4000, 320), (1000, 80), (1000, 1280)):
        record = excitation(model, samples)
        parameters = np.repeat(model.nominal[None], chromosomes, axis=0)
        simulator.errors(parameters, [record])
        start = time.process_time()
        simulator.errors(parameters, [record])
        seconds = time.process_time() - start
        rows.append(
            {
                "samples": samples,
                "chromosomes": chromosomes,
                "microseconds": seconds / samples / chromosomes * 1e6,
            }
        )
    return rows


def _fastest(model: ProcessModel, p: FloatArray) -> float:
    from sysid import jacobian

    rates = np.linalg.eigvals(jacobian(model, model.initial_state, np.zeros(3), p))
    return float(np.abs(rates).max())


def _error(outputs: FloatArray, tight: FloatArray) -> float:
    scale = np.abs(tight).max(axis=0)
    return float(np.max(np.sqrt(np.mean((outputs - tight) ** 2, axis=0)) / scale))


def _best(function: Callable[[], Any], repeats: int = 5) -> float:
    """Shortest of several runs: what the machine does when nothing else interferes."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def _ours(model: ProcessModel, record: Dataset, accuracy: float) -> tuple[float, FloatArray]:
    simulator = BatchSimulator(model, threads=1, accuracy=accuracy)
    parameters = np.repeat(model.nominal[None], 256, axis=0)
    simulator.errors(parameters, [record])
    seconds = _best(lambda: simulator.errors(parameters, [record])) / len(parameters)
    return seconds, simulator.trajectories(model.nominal, record)[0]


def _ours_rk4(model: ProcessModel, record: Dataset) -> tuple[float, FloatArray]:
    """Our kernel with nothing integrated exactly: the same scheme as the C code."""
    simulator = BatchSimulator(model, threads=1)
    simulator._kernels = kernels(model, exact=False)
    parameters = np.repeat(model.nominal[None], 16, axis=0)
    simulator.trajectories(parameters, record, 32)
    seconds = _best(lambda: simulator.trajectories(parameters, record, 32), 10) / len(parameters)
    return seconds, simulator.trajectories(model.nominal, record, 32)[0]


def _c_vectors(record: Dataset, model: ProcessModel) -> tuple[float, None]:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise FileNotFoundError("no C compiler on this machine")
    source = Path(__file__).with_name("_actuator_rk4.c")
    pointer = ctypes.POINTER(ctypes.c_double)
    best = np.inf
    with tempfile.TemporaryDirectory() as folder:
        for lanes in (4, 8, 16):  # whichever width suits this processor best
            library = Path(folder) / f"rk4_{lanes}.so"
            command = [compiler, "-O3", "-march=native", "-ffast-math", "-Wno-psabi"]
            command += [f"-DLANES={lanes}", "-shared", "-fPIC", str(source), "-o", str(library)]
            subprocess.run(command, check=True)
            simulate_c = ctypes.CDLL(str(library)).simulate
            parameters = np.repeat(model.nominal[:19, None], lanes, axis=1)
            sse = np.zeros((3, lanes))
            arguments_ = (
                record.inputs.ctypes.data_as(pointer), SAMPLES,
                np.ascontiguousarray(parameters).ctypes.data_as(pointer),
                ctypes.c_double(record.dt), 32, sse.ctypes.data_as(pointer),
            )  # fmt: skip
            seconds = _best(lambda f=simulate_c, a=arguments_: f(*a), 20)
            best = min(best, seconds / lanes)
    return float(best), None


def _short(record: Dataset) -> Dataset:
    return Dataset(record.inputs[:PEER_SAMPLES], record.outputs[:PEER_SAMPLES], record.dt)


def _derivative(model: ProcessModel) -> Any:
    """The model's derivative compiled, on arrays, with nominal parameters."""
    from sysid._compile import _jit

    compiled = _jit(model.derivative)
    p = tuple(float(v) for v in model.nominal)
    return lambda x, u: compiled(x, u, p)


def _scipy(
    model: ProcessModel, record: Dataset, method: Any, compiled: bool
) -> tuple[float, FloatArray]:
    short = _short(record)
    chosen = model
    if compiled:
        from sysid._compile import _jit

        chosen = replace(model, derivative=_jit(model.derivative))

    def run() -> FloatArray:
        return simulate(chosen, model.nominal, short, method=method, rtol=1e-4, atol=1e-7)

    outputs = run()
    return _best(run, 2) * SAMPLES / PEER_SAMPLES, outputs


def _held(derivative: Any, u: tuple[float, ...]) -> Callable[..., None]:
    def rhs(t: float, y: FloatArray, yp: FloatArray) -> None:
        yp[:] = derivative(tuple(y), u)

    return rhs


def _sundae(model: ProcessModel, record: Dataset) -> tuple[float, FloatArray]:
    import sksundae

    derivative = _derivative(model)
    short = _short(record)

    def run() -> FloatArray:
        x, rows = model.initial_state, []
        for u in short.inputs:
            rows.append(x[[2, 3, 4]])
            rhs = _held(derivative, tuple(u))
            solver = sksundae.cvode.CVODE(rhs, method="BDF", rtol=1e-4, atol=1e-7)
            x = solver.solve(np.array([0.0, short.dt]), x).y[-1]
        return np.array(rows)

    outputs = run()
    return _best(run, 2) * SAMPLES / PEER_SAMPLES, outputs


def _casadi(model: ProcessModel, record: Dataset) -> tuple[float, FloatArray]:
    import casadi

    x, u = casadi.SX.sym("x", 7), casadi.SX.sym("u", 3)
    slope = model.derivative(
        tuple(x[i] for i in range(7)), tuple(u[j] for j in range(3)), tuple(model.nominal)
    )
    problem = {"x": x, "p": u, "ode": casadi.vertcat(*slope)}
    options = {"reltol": 1e-4, "abstol": 1e-7}
    solver = casadi.integrator("solver", "cvodes", problem, 0.0, record.dt, options)
    short = _short(record)

    def run() -> FloatArray:
        state, rows = model.initial_state, []
        for held in short.inputs:
            rows.append(np.asarray(state)[[2, 3, 4]])
            state = np.array(solver(x0=state, p=held)["xf"]).ravel()
        return np.array(rows)

    outputs = run()
    return _best(run, 2) * SAMPLES / PEER_SAMPLES, outputs


def _diffrax(model: ProcessModel, record: Dataset) -> tuple[float, FloatArray]:
    import diffrax
    import jax

    jax.config.update("jax_enable_x64", True)
    jnp = jax.numpy
    p = tuple(float(v) for v in model.nominal)

    def field(t: Any, y: Any, u: Any) -> Any:
        return jnp.stack(model.derivative(tuple(y), tuple(u), p))

    def one(y: Any, u: Any) -> tuple[Any, Any]:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Tsit5(), 0.0, record.dt, 1e-5, y, args=u,
            stepsize_controller=diffrax.PIDController(rtol=1e-4, atol=1e-7),
        )  # fmt: skip
        return solution.ys[-1], y

    @jax.jit
    def run(inputs: Any) -> Any:
        return jax.lax.scan(one, jnp.asarray(model.initial_state), inputs)[1]

    inputs = jnp.asarray(record.inputs)
    outputs = np.asarray(run(inputs))[:, [2, 3, 4]]
    return _best(lambda: run(inputs).block_until_ready(), 3), outputs


def show(figures: dict[str, Any]) -> None:
    print(f"\nOne simulation, 7 states, {SAMPLES} samples, one core")
    print(f"  {'engine':<36} {'ms':>9} {'error':>9} {'ratio':>9}")
    for row in figures["engines"]:
        error = "-" if row["error"] is None else f"{row['error']:.0e}"
        ms, ratio = row["milliseconds"], row["ratio"]
        print(f"  {row['engine']:<36} {ms:9.3f} {error:>9} {ratio:9.1f}")
    for line in figures["missing"]:
        print(f"  left out: {line}")
    box_ = figures["box"]
    print(
        f"\n{box_['chromosomes']} chromosomes of the shipped ranges at accuracy 1e-3: "
        f"{box_['cpu_milliseconds_each']:.3f} ms of CPU and "
        f"{box_['mean_steps_per_sample']:.1f} steps a sample on average\n"
        f"  error: median {box_['median_error']:.1e}, 99th percentile {box_['p99_error']:.1e}, "
        f"above 1e-3: {100 * box_['share_above_1e-3']:.1f} %, "
        f"flagged: {100 * box_['share_flagged']:.1f} %\n"
        f"  of the {box_['feasible']} that satisfy the constraints, above 1e-3: "
        f"{100 * box_['feasible_share_above_1e-3']:.1f} %"
    )
    for row in box_["worst"]:
        print(
            f"  worst of these: error {row['error']:.1e}, "
            f"fastest rate {row['fastest_rate']:.0f} rad/s"
        )
    print("\nCPU microseconds per sample and chromosome")
    for row in figures["linearity"]:
        print(
            f"  {row['samples']:>6} samples, {row['chromosomes']:>5} chromosomes: "
            f"{row['microseconds']:.4f}"
        )


if __name__ == "__main__":
    main()
