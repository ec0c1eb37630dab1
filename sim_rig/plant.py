"""The plant behind the simulated rig: which parts it has, and their values."""

import math
from typing import Any, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from daq.config.base import Section
from daq.config.units import Quantity, converted
from sim_rig.actuator import actuator
from sim_rig.physics import options
from sim_rig.physics.electrical import HIGHEST_ORDER, MAX_CURRENT, SUPPLY, voltages
from sysid import ModelError, ProcessModel
from sysid.arrays import FloatArray

# Sizes of the states that matter, for the accuracy of the simulation.
_SIZES = {
    **{state.name: SUPPLY for state in voltages("motor", HIGHEST_ORDER)},
    **{state.name: SUPPLY for state in voltages("brake", HIGHEST_ORDER)},
    "current_motor": MAX_CURRENT,
    "current_brake": 0.2,
    "omega": 10.0,
    "theta": 1.0,
    "height": 0.1,
    "speed": 0.1,
}


class Plant(Section):
    """The parts of the simulated actuator and what hangs on it."""

    driver_motor: options.MotorDriver = "closed"
    driver_brake: options.BrakeDriver = "closed"
    order_motor: options.MotorOrder = 1
    order_brake: options.BrakeOrder = 1
    output_resistance_motor: options.MotorOutputResistance = False
    output_resistance_brake: options.BrakeOutputResistance = False
    hysteresis: options.Hysteresis = "bouc-wen"
    exponent: options.Exponent = 1.0
    smooth: options.Smooth = False
    friction: options.Friction = "none"
    load: options.PlantLoad = "pulley"
    sensor: options.Sensor = "load"
    parameter_set: options.ParameterSet = "rig"
    parameters: dict[str, Quantity] = Field(
        default_factory=dict, description="values that differ from the set, by name"
    )

    @field_validator("parameters", mode="before")
    @classmethod
    def _in_own_units(cls, values: Any, info: ValidationInfo) -> Any:
        """Numbers of the parameters' units for what is written with a unit."""
        if not isinstance(values, dict) or not any(isinstance(v, str) for v in values.values()):
            return values
        if len(info.data) < len(cls.model_fields) - 1:
            return values  # without its parts there is no plant that could tell
        units = {p.name: p.unit for p in cls(**info.data).build().parameters}
        return {
            name: converted(value, units[name]) if name in units else value
            for name, value in values.items()
        }

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        self.build()
        return self

    def build(self) -> ProcessModel:
        """The whole plant, with the ends of its amplifiers and a hand that may hold the handle.

        Its outputs are the true values of what the rig's sensors see. Raises ModelError for
        values that no such plant can have.
        """
        # A handle is always there, whether or not somebody holds it, unless the shaft is locked.
        loads: dict[str, options.Load] = {"locked": "locked", "pulley": "pulley+hand"}
        model = self._actuator(loads.get(self.load, "hand"), limits=True)
        return _with_values(model, self.parameters)

    def process_model(self) -> ProcessModel:
        """What identification fits to such a plant's logs, at the plant's own values.

        With the torque sensor between motor and brake the load's torque is not in the log: the
        model then has the load itself. Raises ModelError for a hand, whose motion no log holds.
        """
        if self.sensor == "between" and self.load == "hand":
            raise ModelError(
                "a hand moves as it will, and with the torque sensor between motor and brake its "
                "torque is not measured: no model can follow such a log; put the sensor at the load"
            )
        model = self._actuator("measured" if self.sensor == "load" else self.load)
        names = set(model.parameter_names)
        return _with_values(model, {k: v for k, v in self.parameters.items() if k in names})

    def driven(self, turns: float) -> ProcessModel:
        """The whole plant as commands alone drive it, its cable wound up by so many turns.

        Raises ModelError for a hand, whose motion nobody knows beforehand.
        """
        if self.load == "hand":
            raise ModelError("a hand moves as it will: nobody can say what a run would log")
        model = self._actuator(self.load, limits=True, turns=turns)
        return _with_values(model, self.parameters)

    def _actuator(
        self, load: options.Load, limits: bool = False, turns: float = 0.0
    ) -> ProcessModel:
        parts = self.model_dump(exclude={"load", "parameter_set", "parameters"})
        return actuator(
            **parts, load=load, limits=limits, parameters=self.parameter_set, turns=turns
        )


def state_sizes(plant: ProcessModel) -> FloatArray:
    """Magnitude that matters of each of the plant's states, (n_states,)."""
    values = dict(zip(plant.parameter_names, plant.nominal, strict=True))
    # The hysteresis variable at which the model slides; 1 of a brake that never does.
    rise, fall = 1.0, values.get("zeta", 1.0)
    if "A" in values:
        rise, fall = values["A"], values["beta"] + values["gamma"]
    sliding = rise / fall if rise > 0.0 and fall > 0.0 else 1.0
    return np.array([_SIZES.get(name, sliding) for name in plant.state_names])


def _with_values(model: ProcessModel, values: dict[str, float]) -> ProcessModel:
    for name, value in values.items():
        model.parameter(name)
        if not math.isfinite(value):
            raise ModelError(f"parameter {name}: {value} is not a finite number")
        try:
            model = model.with_parameters(**{name: {"nominal": value}})
        except ModelError as error:
            text, key = str(error), f"parameter {name}:"
            raise ModelError(text if text.startswith(key) else f"{key} {text}") from None
    for constraint in model.constraints:
        if constraint.function(tuple(model.nominal)) > 0.0:
            raise ModelError(f"the plant's parameters violate {constraint.text}")
    return model
