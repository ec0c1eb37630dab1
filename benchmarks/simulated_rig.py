"""The simulated rig's speed: open loop against real time, closed loop per tick.

python -m benchmarks.simulated_rig [--json] [--ticks 40000]

The device alone (plant, converters, encoder) and under the layer that makes SI units of it, for
the default plant, one with worn brushes, and one with a hand on it. The peer is SciPy's LSODA
advancing the same plant tick by tick.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks._common import arguments, report
from daq.config.rig import RigConfig
from daq.hal import Guard, Mode
from daq.rig import Rig
from sim_rig.backend import SimulatedDevice, Simulation
from sim_rig.plant import Plant
from sysid.arrays import FloatArray

RATE = 800.0
PEER_TICKS = 400
PLANTS = {
    "default": Plant(),
    "cyclic brushes": Plant(friction="cyclic"),
    "LuGre, hand, open drivers": Plant(
        hysteresis="lugre", load="hand", driver_motor="open", driver_brake="open"
    ),
}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--ticks", type=int, default=40_000)
    options = parser.parse_args()
    rows = [measure(name, plant, options.ticks) for name, plant in PLANTS.items()]
    report({"ticks": options.ticks, "plants": rows}, options.json, show)


def measure(name: str, plant: Plant, ticks: int) -> dict[str, Any]:
    """Microseconds a tick in every way of running one plant."""
    commands = waveform(ticks)
    open_loop = min(_open_loop(_device(plant), commands) for _ in range(3))
    closed = min(_closed_loop(_device(plant), commands[:8000]) for _ in range(3))
    rig = min(_rig_closed_loop(plant, commands[:8000]) for _ in range(3))
    return {
        "plant": name,
        "open_loop_us": open_loop * 1e6,
        "times_real_time": 1.0 / (RATE * open_loop),
        "closed_loop_us": closed * 1e6,
        "closed_loop_si_us": rig * 1e6,
        "lsoda_us": _peer(plant, commands) * 1e6,
    }


def waveform(ticks: int) -> FloatArray:
    """Random binary commands as in the shipped experiment."""
    rng = np.random.default_rng(2)
    motor = np.repeat(rng.choice([-0.65, 0.85], ticks // 4 + 1), 4)[:ticks]
    brake = np.repeat(rng.choice([0.0, 0.14], ticks // 40 + 1), 40)[:ticks]
    return np.stack([motor, brake], axis=1)


def _device(plant: Plant) -> SimulatedDevice:
    device = SimulatedDevice(Simulation(plant=plant))
    device.open()
    return device


_GUARD = Guard(np.array([-5.0, 0.0]), np.array([5.0, 0.38]), np.full(3, -9.0), np.full(3, 9.0))


def _open_loop(device: SimulatedDevice, commands: FloatArray) -> float:
    device.start(RATE, Mode.OPEN_LOOP, _GUARD)
    device.send(0, commands[:256])
    device.receive()
    start, done = time.perf_counter(), 256
    for first in range(256, len(commands), 8192):
        device.send(first, commands[first : first + 8192])
        while done < min(first + 8192, len(commands)):
            done += len(device.receive().tick)
    return (time.perf_counter() - start) / (len(commands) - 256)


def _closed_loop(device: SimulatedDevice, commands: FloatArray) -> float:
    device.start(RATE, Mode.CLOSED_LOOP, _GUARD)
    start = time.perf_counter()
    for tick in range(len(commands)):
        device.send(tick, commands[tick : tick + 1])
        device.receive()
    return (time.perf_counter() - start) / len(commands)


def _rig_closed_loop(plant: Plant, commands: FloatArray) -> float:
    with Rig(_device(plant), RigConfig()) as rig:
        rig.start(RATE, Mode.CLOSED_LOOP)
        start = time.perf_counter()
        for tick in range(len(commands)):
            rig.send(tick, commands[tick : tick + 1])
            rig.receive()
        return (time.perf_counter() - start) / len(commands)


def _peer(plant: Plant, commands: FloatArray) -> float:
    """SciPy, with the derivative compiled."""
    from scipy.integrate import solve_ivp

    from sysid.engine.compiler import machine_code

    model = plant.build()
    compiled = machine_code(model.derivative)
    model = replace(model, derivative=compiled)
    p, x = tuple(model.nominal), model.initial_state
    rest = (0.0,) * (len(model.inputs) - 2)

    def rhs(t: float, state: FloatArray, u: tuple[float, ...]) -> FloatArray:
        return np.array(compiled(tuple(state), u, p))

    rhs(0.0, x, (0.0, 0.0, *rest))
    start = time.perf_counter()
    for command in commands[:PEER_TICKS]:
        u = (float(command[0]), float(command[1]), *rest)
        x = solve_ivp(rhs, (0.0, 1.0 / RATE), x, "LSODA", args=(u,), rtol=1e-6, atol=1e-8).y[:, -1]
    return (time.perf_counter() - start) / PEER_TICKS


def show(figures: dict[str, Any]) -> None:
    print(f"\nMicroseconds a tick at {RATE:g} Hz, {figures['ticks']} ticks")
    print(
        f"  {'plant':<28} {'open loop':>9} {'x real time':>12} {'closed':>8} "
        f"{'with SI':>8} {'LSODA':>9} {'ratio':>8}"
    )
    for row in figures["plants"]:
        print(
            f"  {row['plant']:<28} {row['open_loop_us']:9.2f} {row['times_real_time']:12.0f} "
            f"{row['closed_loop_us']:8.1f} {row['closed_loop_si_us']:8.1f} "
            f"{row['lsoda_us']:9.0f} {row['lsoda_us'] / row['open_loop_us']:8.0f}"
        )


if __name__ == "__main__":
    main()
