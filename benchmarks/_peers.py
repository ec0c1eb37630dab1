"""What a lab could simulate the actuator with: our engine, SciPy's, others, and plain C."""

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

from sysid import BatchSimulator, Dataset
from sysid.arrays import FloatArray
from sysid.engine.compiler import kernels
from sysid.engine.scheme import LANES
from sysid.problem.model import ProcessModel
from tests.sysid.reference import simulate

RK4_STEPS = 32  # per sample, of the C code and of ours beside it
PEER_SAMPLES = 100  # slow peers run the record's start; their time per sample is constant


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


def _error(outputs: FloatArray, tight: FloatArray) -> float:
    scale = np.abs(tight).max(axis=0)
    return float(np.max(np.sqrt(np.mean((outputs - tight) ** 2, axis=0)) / scale))


def best(function: Callable[[], Any], repeats: int = 5) -> float:
    """Shortest of several runs: what the machine does when nothing else interferes.

    Short ones are repeated for half a second, longer than most disturbances last.
    """
    times = []
    until = time.perf_counter() + 0.5
    while len(times) < repeats or time.perf_counter() < until:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def _ours(model: ProcessModel, record: Dataset, accuracy: float) -> tuple[float, FloatArray]:
    simulator = BatchSimulator(model, threads=1, accuracy=accuracy)
    parameters = np.repeat(model.nominal[None], 256, axis=0)
    simulator.errors(parameters, [record])
    seconds = best(lambda: simulator.errors(parameters, [record])) / len(parameters)
    return seconds, simulator.trajectories(model.nominal, record)[0]


def _ours_rk4(model: ProcessModel, record: Dataset) -> tuple[float, FloatArray]:
    """Our kernel with nothing integrated exactly: the same scheme as the C code."""
    simulator = BatchSimulator(model, threads=1)
    simulator._kernels = kernels(model, exact=False)
    seconds = fixed_steps(simulator, record, RK4_STEPS)
    return seconds, simulator.trajectories(model.nominal, record, RK4_STEPS)[0]


def fixed_steps(simulator: BatchSimulator, record: Dataset, n_steps: int) -> float:
    """Seconds to the error sums of one chromosome, as one of a block, at so many steps."""
    parameters = np.repeat(simulator.model.nominal[None], LANES, axis=0)
    lanes, nothing = np.arange(LANES), np.empty((0, 0, 0))
    on_record = simulator._on(record, np.ones(len(simulator.model.outputs)))

    def run() -> None:
        on_record.block(parameters, None, lanes, n_steps, record.n_samples, nothing)

    run()
    return best(run) / LANES


def _c_vectors(record: Dataset, model: ProcessModel) -> tuple[float, None]:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise FileNotFoundError("no C compiler on this machine")
    source = Path(__file__).with_name("_actuator_rk4.c")
    pointer = ctypes.POINTER(ctypes.c_double)
    least = np.inf
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
                record.inputs.ctypes.data_as(pointer), record.n_samples,
                np.ascontiguousarray(parameters).ctypes.data_as(pointer),
                ctypes.c_double(record.dt), RK4_STEPS, sse.ctypes.data_as(pointer),
            )  # fmt: skip
            seconds = best(lambda f=simulate_c, a=arguments_: f(*a))
            least = min(least, seconds / lanes)
    return float(least), None


def _short(record: Dataset) -> Dataset:
    return Dataset(record.inputs[:PEER_SAMPLES], record.outputs[:PEER_SAMPLES], record.dt)


def _derivative(model: ProcessModel) -> Any:
    """The model's derivative compiled, on arrays, with nominal parameters."""
    from sysid.engine.compiler import machine_code

    compiled = machine_code(model.derivative)
    p = tuple(float(v) for v in model.nominal)
    return lambda x, u: compiled(x, u, p)


def _scipy(
    model: ProcessModel, record: Dataset, method: Any, compiled: bool
) -> tuple[float, FloatArray]:
    short = _short(record)
    chosen = model
    if compiled:
        from sysid.engine.compiler import machine_code

        chosen = replace(model, derivative=machine_code(model.derivative))

    def run() -> FloatArray:
        return simulate(chosen, model.nominal, short, method=method, rtol=1e-4, atol=1e-7)

    outputs = run()
    return best(run, 2) * record.n_samples / PEER_SAMPLES, outputs


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
    return best(run, 2) * record.n_samples / PEER_SAMPLES, outputs


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
    return best(run, 2) * record.n_samples / PEER_SAMPLES, outputs


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
    return best(lambda: run(inputs).block_until_ready(), 3), outputs
