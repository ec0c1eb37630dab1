"""The hybrid actuator as a process model (3.23), (3.24), put together from its parts.

One shaft carries, from left to right, the motor, the brake, the torque sensor and the load; or,
with ``sensor="between"``, the motor, the torque sensor, the brake and the load (figure 2.2).
The brushes of the torque sensor, where their friction is modelled, rub on its brake side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sim_rig import electrical, loads, values
from sim_rig import friction as frictions
from sim_rig import hysteresis as hystereses
from sim_rig.guesses import guesses
from sim_rig.options import (
    BrakeDriver,
    Exponent,
    Friction,
    Hysteresis,
    Limits,
    Load,
    MotorDriver,
    ParameterSet,
    Sensor,
    SensorPlace,
    Smooth,
)
from sim_rig.parts import Layout, known, log_range
from sim_rig.plots import operating_points, plots
from sim_rig.wording import equations
from sysid import Constraint, Input, ModelError, Output, ProcessModel, State
from sysid.problem.model import picker

OUTPUTS = (
    Output("current_motor", "A"),
    Output("current_brake", "A"),
    Output("torque", "N*m", "at the torque sensor; positive where it speeds the brake up"),
    Output("theta", "rad", "shaft angle"),
    Output("omega", "rad/s", "shaft speed"),
)

_COMMANDS = (
    Input("applied_voltage_motor", "V", "zoh", "command at the motor amplifier's input"),
    Input("applied_voltage_brake", "V", "zoh", "command at the brake amplifier's input"),
)

_ROTORS = (
    log_range("J_m", "kg*m^2", 5e-5, 1e-5, 2e-4, "motor inertia"),
    log_range("B_m", "N*m*s/rad", 1e-4, 1e-5, 3e-3, "motor viscous damping"),
    log_range("J_b", "kg*m^2", 2e-5, 3e-6, 1e-4, "brake inertia"),
)

_CONSTANTS = (
    known("K_v2i", "A/V", 0.5, "amplifier gain"),
    known("n_c", "1", -1.0, "transmission ratio of the motor; -1 is a direct coupling", -100.0),
)

# Where each measured signal stands among the shaft's states.
_OMEGA, _THETA = 4, 6


def actuator(
    *,
    driver_motor: MotorDriver = "closed",
    driver_brake: BrakeDriver = "closed",
    hysteresis: Hysteresis = "bouc-wen",
    exponent: Exponent = 1.0,
    smooth: Smooth = False,
    friction: Friction = "none",
    load: Load = "measured",
    sensor: Sensor = "load",
    limits: Limits = False,
    parameters: ParameterSet = "nominal",
    outputs: tuple[str, ...] = (),
) -> ProcessModel:
    """The actuator with the given parts, its parameters at a named set.

    The choices are explained in ``sim_rig.options``. With a measured load the torque sensor's
    signal is an input and no output. outputs: names, default the currents and the speed for a
    measured load (3.24), and all five signals of the rig for the others. Raises ModelError for
    parts that do not go together.
    """
    if load == "measured" and sensor != "load":
        raise ModelError(
            "a measured load is read from a torque sensor at the load; with the sensor between "
            "motor and brake say what the load is: free, locked, pulley or hand"
        )
    if load == "measured":
        outputs = outputs or ("current_motor", "current_brake", "omega")
    outputs = outputs or tuple(output.name for output in OUTPUTS)
    parts = _Parts(
        electrical.driver(driver_motor, limits),
        electrical.driver(driver_brake, limits),
        electrical.limited_winding if limits else electrical.winding,
        hystereses.hysteresis(hysteresis, smooth, exponent),
        frictions.friction(friction),
        loads.load(load),
        locked=load == "locked",
    )
    layout = Layout.of(
        driver_motor=electrical.motor_driver_parameters(driver_motor),
        driver_brake=electrical.brake_driver_parameters(driver_brake),
        windings=electrical.WINDINGS,
        rotors=_ROTORS,
        hysteresis=parts.hysteresis.parameters,
        friction=parts.friction.parameters,
        load=parts.load.parameters,
        constants=_CONSTANTS,
    )
    shaft = _shaft(parts, layout, sensor)
    model = ProcessModel(
        name="actuator",
        description=_describe(driver_motor, driver_brake, hysteresis, smooth, friction, load),
        states=_states(parts),
        inputs=_COMMANDS + parts.load.inputs,
        outputs=_chosen(outputs, measured=load == "measured"),
        parameters=layout.parameters,
        derivative=_derivative(parts, layout, shaft),
        output=_output(outputs, shaft) if "torque" in outputs else None,
        constraints=_constraints(parts, layout),
        guesses=guesses(driver_motor, driver_brake, load, friction),
        plots=plots,
        operating_points=operating_points,
        equations=equations(
            driver_motor, driver_brake, hysteresis, smooth, exponent, friction, load
        ),
    )
    known_here = values.named(parameters, driver_motor, driver_brake, hysteresis, exponent)
    changes = {k: {"nominal": v} for k, v in known_here.items() if k in model.parameter_names}
    return model.with_parameters(**changes)


@dataclass(frozen=True)
class _Parts:
    driver_motor: electrical.DriverFunction
    driver_brake: electrical.DriverFunction
    winding: Callable[[Any, Any, Any, Any, Any], Any]
    hysteresis: hystereses.Hysteresis
    friction: frictions.Friction
    load: loads.Load
    locked: bool


def _states(parts: _Parts) -> tuple[State, ...]:
    return (
        State("voltage_motor", "V", description="amplifier output at the motor"),
        State("voltage_brake", "V", description="amplifier output at the brake coil"),
        State("current_motor", "A"),
        State("current_brake", "A"),
        State("omega", "rad/s", description="shaft speed"),
        State(
            "z",
            parts.hysteresis.z_unit,
            description="hysteresis variable",
            initial_range=parts.hysteresis.z_range,
        ),
        State("theta", "rad", description="shaft angle"),
        *parts.load.states,
    )


def _derivative(parts: _Parts, layout: Layout, shaft: _Shaft) -> Callable[..., tuple[Any, ...]]:
    driver_m, driver_b, winding = parts.driver_motor, parts.driver_brake, parts.winding
    rate = parts.hysteresis.rate
    own, locked = layout.slices, parts.locked
    of_driver_m, of_driver_b = own["driver_motor"], own["driver_brake"]
    of_windings, of_hysteresis, of_constants = own["windings"], own["hysteresis"], own["constants"]

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        v_m, v_b, i_m, i_b, omega, z, _theta = x[:7]
        if locked:
            omega = 0.0  # also where noise in a first sample says otherwise
        command_m, command_b = u[:2]
        R_m, L_m, K_m, R_b, L_b = p[of_windings]
        K_v2i, n_c = p[of_constants]
        acceleration, _torque, load_rates = shaft(x, u, p)
        return (
            driver_m(v_m, i_m, command_m, K_v2i, p[of_driver_m]),
            driver_b(v_b, i_b, command_b, K_v2i, p[of_driver_b]),
            winding(i_m, v_m, -n_c * K_m * omega, R_m, L_m),
            winding(i_b, v_b, 0.0, R_b, L_b),
            acceleration,
            rate(omega, z, p[of_hysteresis]),
            omega,
            *load_rates,
        )

    return derivative


# (x, u, p) -> angular acceleration, torque at the sensor, rates of the load's states
_Shaft = Callable[[Any, Any, Any], tuple[Any, Any, tuple[Any, ...]]]


def _shaft(parts: _Parts, layout: Layout, sensor: SensorPlace) -> _Shaft:
    """Newton's second law for all that turns (3.22), and what the torque sensor sees of it."""
    rate, resisting = parts.hysteresis.rate, parts.hysteresis.torque
    rubbing, load_torque, load_inertia = (
        parts.friction.torque,
        parts.load.torque,
        parts.load.inertia,
    )
    own = layout.slices
    of_rotors, of_hysteresis, of_friction = own["rotors"], own["hysteresis"], own["friction"]
    of_load, of_constants, motor_constant = own["load"], own["constants"], own["windings"].start + 2
    locked, at_load = parts.locked, sensor == "load"

    def shaft(x: Any, u: Any, p: Any) -> tuple[Any, Any, tuple[Any, ...]]:
        i_m, i_b, omega, z, theta = x[2:7]
        if locked:
            omega = 0.0
        J_m, B_m, J_b = p[of_rotors]
        K_m = p[motor_constant]
        _K_v2i, n_c = p[of_constants]
        from_load = load_torque(theta, omega, x[7:], u[2:], p[of_load])
        J_load = load_inertia(p[of_load])
        q = p[of_hysteresis]
        brake = resisting(i_b, omega, z, rate(omega, z, q), q)
        brushes = rubbing(theta, omega, p[of_friction])
        motor = -n_c * K_m * i_m - n_c * n_c * B_m * omega
        rest = motor - brake - brushes
        if locked:
            return 0.0, -rest if at_load else motor, from_load[1:]
        acceleration = (rest + from_load[0]) / (n_c * n_c * J_m + J_b + J_load)
        if at_load:
            return acceleration, from_load[0] - J_load * acceleration, from_load[1:]
        return acceleration, motor - n_c * n_c * J_m * acceleration, from_load[1:]

    return shaft


def _chosen(names: tuple[str, ...], measured: bool) -> tuple[Output, ...]:
    known_outputs = {output.name: output for output in OUTPUTS}
    for name in names:
        if name not in known_outputs:
            raise ModelError(
                f"the actuator has no output {name!r}; it has {', '.join(known_outputs)}"
            )
    if measured and "torque" in names:
        raise ModelError(
            "with a measured load the torque is an input; to have it as an output say what the "
            "load is: free, locked, pulley or hand"
        )
    return tuple(known_outputs[name] for name in names)


def _output(names: tuple[str, ...], shaft: _Shaft) -> Callable[..., tuple[Any, ...]]:
    everything = [output.name for output in OUTPUTS]
    pick = picker([everything.index(name) for name in names])

    def output(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        torque = shaft(x, u, p)[1]
        return pick((x[2], x[3], torque, x[_THETA], x[_OMEGA]))

    return output


def _constraints(parts: _Parts, layout: Layout) -> tuple[Constraint, ...]:
    """Section 3.4.2, of whichever parts there are."""
    return tuple(
        layout.constraint(part, text, function)
        for part, own in (
            ("hysteresis", parts.hysteresis.constraints),
            ("friction", parts.friction.constraints),
        )
        for text, function in own
    )


def _describe(
    driver_motor: str, driver_brake: str, hysteresis: str, smooth: bool, friction: str, load: str
) -> str:
    drivers = (
        f"{driver_motor}-loop drivers"
        if driver_motor == driver_brake
        else f"{driver_motor}-loop motor and {driver_brake}-loop brake driver"
    )
    named = {"bouc-wen": "Bouc-Wen", "dahl": "Dahl", "lugre": "LuGre"}[hysteresis]
    brake = f"DC motor, magnetorheological brake with {'smooth ' * smooth}{named} hysteresis"
    rubbing = {"none": "", "stribeck": ", brush friction", "cyclic": ", cyclic brush friction"}
    return f"{drivers}, {brake}{rubbing[friction]}, {load} load"
