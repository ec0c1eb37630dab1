"""The hybrid actuator as a process model (3.23), (3.24), put together from its parts.

One shaft carries, from left to right, the motor, the brake, the torque sensor and the load; or,
with ``sensor="between"``, the motor, the torque sensor, the brake and the load (figure 2.2).
The brushes of the torque sensor, where their friction is modelled, rub on its brake side.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from sim_rig.guesses import guesses
from sim_rig.physics import electrical, options, values
from sim_rig.physics.friction import FRICTIONS
from sim_rig.physics.hysteresis import hysteresis as hysteresis_model
from sim_rig.physics.loads import LOADS, wound_up
from sim_rig.physics.options import Design
from sim_rig.physics.parameters import Layout, constraints, fixed, log_range
from sim_rig.plots import operating_points, plots
from sysid import Input, ModelError, Output, ProcessModel, State
from sysid.arrays import FloatArray
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
    fixed("K_v2i", "A/V", 0.5, "amplifier gain"),
    fixed("n_c", "1", -1.0, "transmission ratio of the motor; -1 is a direct coupling", -100.0),
)

# (x, u, p) -> angular acceleration, torque at the sensor, rates of the load's states
_Shaft = Callable[[Any, Any, Any], tuple[Any, Any, tuple[Any, ...]]]


def actuator(
    *,
    driver_motor: options.MotorDriver = "closed",
    driver_brake: options.BrakeDriver = "closed",
    order_motor: options.MotorOrder = 1,
    order_brake: options.BrakeOrder = 1,
    output_resistance_motor: options.MotorOutputResistance = False,
    output_resistance_brake: options.BrakeOutputResistance = False,
    hysteresis: options.Hysteresis = "bouc-wen",
    exponent: options.Exponent = 1.0,
    smooth: options.Smooth = False,
    friction: options.Friction = "none",
    load: options.Load = "measured",
    sensor: options.Sensor = "load",
    limits: options.Limits = False,
    parameters: options.ParameterSet = "nominal",
    outputs: tuple[str, ...] = (),
    turns: options.Turns = 0.0,
) -> ProcessModel:
    """The actuator with the given parts, its parameters at a named set.

    The choices are explained in ``sim_rig.physics.options``. With a measured load the torque
    sensor's signal is an input and no output. outputs: names, default the currents and the speed
    for a measured load (3.24), and all five signals of the rig for the others. Raises ModelError
    for parts that do not go together.

    >>> actuator(hysteresis="dahl", outputs=("omega",)).output_names
    ('omega',)
    """
    design = Design(
        driver_motor, driver_brake, order_motor, order_brake, output_resistance_motor,
        output_resistance_brake, hysteresis, exponent, smooth, friction, load, sensor, limits,
    )  # fmt: skip
    if load == "measured":
        if sensor != "load":
            raise ModelError(
                "a measured load is read from a torque sensor at the load; with the sensor between "
                "motor and brake say what the load is: free, locked, pulley or hand"
            )
        outputs = outputs or ("current_motor", "current_brake", "omega")
    outputs = outputs or tuple(output.name for output in OUTPUTS)
    model = replace(_Assembly(design).model(outputs), variants=_variants(design, outputs))
    named = values.named(parameters, design)
    changes = {k: {"nominal": v} for k, v in named.items() if k in model.parameter_names}
    model = model.with_parameters(**changes)
    return model.with_initial(wound_up(model, turns)) if turns else model


def regressors(record: Any) -> dict[str, FloatArray]:
    """The brake's torque but for its constant, which a linear model of the actuator cannot form."""
    if "current_brake" not in record or "omega" not in record:
        return {}
    return {"current_brake*sign(omega)": record["current_brake"] * np.sign(record["omega"])}


def _variants(design: Design, outputs: tuple[str, ...]) -> Callable[[], Mapping[str, ProcessModel]]:
    """The actuator with one part more than the design, by the option that adds it.

    Values of what they add are the simulated rig's: where it may be looked for.
    """
    more: dict[str, dict[str, Any]] = {}
    if design.friction == "none":
        more["friction=stribeck"] = {"friction": "stribeck"}
    if design.friction != "cyclic":
        more["friction=cyclic"] = {"friction": "cyclic"}
    if not design.limits:
        more["limits=true"] = {"limits": True}
    if design.hysteresis == "bouc-wen" and design.exponent == 1.0:
        more["exponent=2"] = {"exponent": 2.0}

    def variants() -> Mapping[str, ProcessModel]:
        parts = {**asdict(design), "outputs": outputs}
        return {name: actuator(**{**parts, **changes}) for name, changes in more.items()}

    return variants


class _Assembly:
    """Parts of one design, their parameters behind one another.

    The equations are plain functions of tuples that take all they need from their closure, as
    the compiler wants them.
    """

    def __init__(self, design: Design) -> None:
        self._design, self._locked = design, design.load == "locked"
        self._hysteresis = hysteresis_model(design.hysteresis, design.smooth, design.exponent)
        self._friction = FRICTIONS[design.friction]
        self._load = LOADS[design.load]
        motor, brake = design.order_motor, design.order_brake
        self._parameters = Layout(
            driver_motor=electrical.driver_parameters("motor", design.driver_motor, motor),
            driver_brake=electrical.driver_parameters("brake", design.driver_brake, brake),
            windings=electrical.WINDINGS,
            output_motor=electrical.output_resistance("motor", design.output_resistance_motor),
            output_brake=electrical.output_resistance("brake", design.output_resistance_brake),
            rotors=_ROTORS,
            hysteresis=self._hysteresis.parameters,
            friction=self._friction.parameters,
            load=self._load.parameters,
            constants=_CONSTANTS,
        )
        z = State(
            "z",
            self._hysteresis.z_unit,
            description="hysteresis variable",
            initial_range=self._hysteresis.z_range,
        )
        self._states = Layout(
            driver_motor=electrical.voltages("motor", motor),
            driver_brake=electrical.voltages("brake", brake),
            currents=(State("current_motor", "A"), State("current_brake", "A")),
            shaft=(
                State("omega", "rad/s", description="shaft speed"),
                z,
                State("theta", "rad", description="shaft angle"),
            ),
            load=self._load.states,
        )
        self._inputs = Layout(commands=_COMMANDS, load=self._load.inputs)

    def model(self, outputs: tuple[str, ...]) -> ProcessModel:
        """The process model with outputs by name."""
        design, places, shaft = self._design, self._parameters.slices, self._shaft()
        return ProcessModel(
            name="actuator",
            description=_description(design),
            states=self._states.members,
            inputs=self._inputs.members,
            outputs=_chosen(outputs, measured=design.load == "measured"),
            parameters=self._parameters.members,
            derivative=self._derivative(shaft),
            output=self._output(outputs, shaft) if "torque" in outputs else None,
            constraints=(  # section 3.4.2
                *constraints(places["hysteresis"], self._hysteresis.constraints),
                *constraints(places["friction"], self._friction.constraints),
            ),
            guesses=guesses(design),
            plots=plots,
            operating_points=operating_points,
            regressors=regressors,
            equations=self._equations(),
            assumptions=electrical.limit_assumptions(
                design.limits, design.driver_brake, design.output_resistance_brake
            ),
        )

    def _derivative(self, shaft: _Shaft) -> Callable[..., tuple[Any, ...]]:
        design, place, states = self._design, self._parameters.slices, self._states.slices
        drive_m = electrical.drive(design.driver_motor, design.limits)
        drive_b = electrical.drive(design.driver_brake, design.limits)
        amplifier = electrical.amplifier
        winding = electrical.limited_winding if design.limits else electrical.winding
        rate, locked = self._hysteresis.rate, self._locked
        of_driver_m, of_driver_b = place["driver_motor"], place["driver_brake"]
        of_output_m, of_output_b = place["output_motor"], place["output_brake"]
        of_windings, of_constants = place["windings"], place["constants"]
        of_hysteresis = place["hysteresis"]
        voltages_m, voltages_b = states["driver_motor"], states["driver_brake"]
        currents, on_shaft = states["currents"], states["shaft"]
        commands = self._inputs.slices["commands"]

        def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            v_m, v_b = x[voltages_m], x[voltages_b]
            i_m, i_b = x[currents]
            omega, z, _theta = x[on_shaft]
            if locked:
                omega = 0.0  # also where noise in a first sample says otherwise
            command_m, command_b = u[commands]
            gain_m, *cutoffs_m = p[of_driver_m]
            gain_b, *cutoffs_b = p[of_driver_b]
            R_m, L_m, K_m, R_b, L_b = p[of_windings]
            K_v2i, n_c = p[of_constants]
            acceleration, _torque, load_rates = shaft(x, u, p)
            return (
                *amplifier(v_m, drive_m(i_m, command_m, K_v2i, gain_m), cutoffs_m),
                *amplifier(v_b, drive_b(i_b, command_b, K_v2i, gain_b), cutoffs_b),
                winding(i_m, v_m[0], -n_c * K_m * omega, sum(p[of_output_m], R_m), L_m),
                winding(i_b, v_b[0], 0.0, sum(p[of_output_b], R_b), L_b),
                acceleration,
                rate(omega, z, p[of_hysteresis]),
                omega,
                *load_rates,
            )

        return derivative

    def _shaft(self) -> _Shaft:
        """Newton's second law for all that turns (3.22), and what the torque sensor sees of it."""
        place, locked = self._parameters.slices, self._locked
        at_load = self._design.sensor == "load"
        rate, brake_torque = self._hysteresis.rate, self._hysteresis.torque
        brush_torque, load_torque = self._friction.torque, self._load.torque
        load_inertia = self._load.inertia
        of_rotors, of_hysteresis, of_windings = (
            place["rotors"],
            place["hysteresis"],
            place["windings"],
        )
        of_friction, of_load, of_constants = place["friction"], place["load"], place["constants"]
        states, pushes = self._states.slices, self._inputs.slices["load"]
        currents, on_shaft, load_states = states["currents"], states["shaft"], states["load"]

        def shaft(x: Any, u: Any, p: Any) -> tuple[Any, Any, tuple[Any, ...]]:
            i_m, i_b = x[currents]
            omega, z, theta = x[on_shaft]
            if locked:
                omega = 0.0
            J_m, B_m, J_b = p[of_rotors]
            _R_m, _L_m, K_m, _R_b, _L_b = p[of_windings]
            _K_v2i, n_c = p[of_constants]
            from_load = load_torque(theta, omega, x[load_states], u[pushes], p[of_load])
            J_load = load_inertia(p[of_load])
            q = p[of_hysteresis]
            brake = brake_torque(i_b, omega, z, rate(omega, z, q), q)
            brushes = brush_torque(theta, omega, p[of_friction])
            motor = -n_c * K_m * i_m - n_c * n_c * B_m * omega
            rest = motor - brake - brushes
            if locked:
                return 0.0, -rest if at_load else motor, from_load[1:]
            acceleration = (rest + from_load[0]) / (n_c * n_c * J_m + J_b + J_load)
            if at_load:
                return acceleration, from_load[0] - J_load * acceleration, from_load[1:]
            return acceleration, motor - n_c * n_c * J_m * acceleration, from_load[1:]

        return shaft

    def _output(self, names: tuple[str, ...], shaft: _Shaft) -> Callable[..., tuple[Any, ...]]:
        order = [output.name for output in OUTPUTS]
        pick = picker([order.index(name) for name in names])
        currents, on_shaft = self._states.slices["currents"], self._states.slices["shaft"]

        def output(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            i_m, i_b = x[currents]
            omega, _z, theta = x[on_shaft]
            return pick((i_m, i_b, shaft(x, u, p)[1], theta, omega))

        return output

    def _equations(self) -> tuple[str, ...]:
        """The equations as text, for people: one line each, in the parameters' names.

        A test evaluates them against the functions.
        Currents, voltages and commands have the symbols of the thesis, i, v and u with an index
        m (motor) or b (brake).
        """
        design, brushes = self._design, self._friction.equation
        inertia = "n_c^2*J_m + J_b"
        torque = "-n_c*K_m*i_m - n_c^2*B_m*omega - tau_b" + " - tau_f" * bool(brushes)
        of_load: tuple[str, ...] = ()
        if design.load == "measured":
            torque += " + torque"
        elif design.load not in ("free", "locked"):
            inertia, torque = f"{inertia} + J_load", f"{torque} + tau_load"
            of_load = ("tau_load and J_load: torque and inertia of the load",)
        return (
            *electrical.driver_equations(
                design.driver_motor, design.order_motor, "m", design.limits
            ),
            *electrical.driver_equations(
                design.driver_brake, design.order_brake, "b", design.limits
            ),
            *electrical.winding_equations(
                design.output_resistance_motor, design.output_resistance_brake, design.limits
            ),
            *self._hysteresis.equations,
            *filter(None, [brushes]),
            "domega/dt = 0" if self._locked else f"({inertia}) domega/dt = {torque}",
            "dtheta/dt = omega",
            "u: commands, v: voltages and i: currents of motor (m) and brake (b); z: hysteresis; "
            "theta: angle",
            *electrical.limit_equations(design.limits),
            *of_load,
        )


def _chosen(names: tuple[str, ...], measured: bool) -> tuple[Output, ...]:
    available = {output.name: output for output in OUTPUTS}
    for name in names:
        if name not in available:
            raise ModelError(f"the actuator has no output {name!r}; it has {', '.join(available)}")
    if measured and "torque" in names:
        raise ModelError(
            "with a measured load the torque is an input; to have it as an output say what the "
            "load is: free, locked, pulley or hand"
        )
    return tuple(available[name] for name in names)


def _description(design: Design) -> str:
    motor = _driver(design.driver_motor, design.order_motor, design.output_resistance_motor)
    brake = _driver(design.driver_brake, design.order_brake, design.output_resistance_brake)
    drivers = f"{motor[0]} drivers{motor[1]}"
    if motor != brake:
        drivers = f"{motor[0]} motor driver{motor[1]} and {brake[0]} brake driver{brake[1]}"
    if design.limits:
        drivers += f" that end at {electrical.SUPPLY:g} V and {electrical.MAX_CURRENT:g} A"
    kind = {"bouc-wen": "Bouc-Wen", "dahl": "Dahl", "lugre": "LuGre"}[design.hysteresis]
    hysteresis = (
        f"magnetorheological brake with {'smooth ' if design.smooth else ''}{kind} hysteresis"
    )
    friction = FRICTIONS[design.friction].name
    return ", ".join(
        filter(None, [drivers, "DC motor", hysteresis, friction, f"{design.load} load"])
    )


def _driver(kind: options.DriverKind, order: int, output_resistance: bool) -> tuple[str, str]:
    """Adjectives of an amplifier, and what follows its noun."""
    word = "" if order == 1 else f"{('second', 'third')[order - 2]}-order "
    return f"{word}{kind}-loop", " with output resistance" if output_resistance else ""
