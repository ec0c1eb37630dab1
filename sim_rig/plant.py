"""The plant behind the simulated rig: which parts it has, and their values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from daq.config.base import Section
from daq.config.units import Quantity, converted
from sim_rig.actuator import actuator
from sim_rig.physics.electrical import MAX_CURRENT, SUPPLY
from sim_rig.physics.options import (
    BrakeDriver,
    Exponent,
    Friction,
    Hysteresis,
    LoadKind,
    MotorDriver,
    ParameterSet,
    PlantLoad,
    Sensor,
    Smooth,
)
from sysid import ModelError, ProcessModel
from sysid.arrays import FloatArray

# Sizes of the states that matter, for the accuracy of the simulation.
_SIZES = {
    "voltage_motor": SUPPLY,
    "voltage_brake": SUPPLY,
    "current_motor": MAX_CURRENT,
    "current_brake": 0.2,
    "omega": 10.0,
    "theta": 1.0,
    "height": 0.1,
    "speed": 0.1,
}


class Plant(Section):
    """The parts of the simulated actuator and what hangs on it."""

    driver_motor: MotorDriver = "closed"
    driver_brake: BrakeDriver = "closed"
    hysteresis: Hysteresis = "bouc-wen"
    exponent: Exponent = 1.0
    smooth: Smooth = False
    friction: Friction = "none"
    load: PlantLoad = "pulley"
    sensor: Sensor = "load"
    parameter_set: ParameterSet = "rig"
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
    def _can_be_built(self) -> Plant:
        self.build()
        return self

    def build(self) -> ProcessModel:
        """The whole plant, with the ends of its amplifiers and a hand that may hold the handle.

        Its outputs are the true values of what the rig's sensors see. Raises ModelError for
        values that no such plant can have.
        """
        # A handle is always there, whether or not somebody holds it, unless the shaft is locked.
        loads: dict[str, LoadKind] = {"locked": "locked", "pulley": "pulley+hand"}
        model = actuator(
            **self._parts(), load=loads.get(self.load, "hand"), sensor=self.sensor, limits=True
        )
        return _with_values(model, self.parameters)

    def process_model(self) -> ProcessModel:
        """What identification fits to such a plant's logs, at the plant's own values.

        With the torque sensor between motor and brake the load's torque is not in the log: the
        model then has the load itself. Raises ModelError for a hand, whose motion no log holds.
        """
        if self.sensor == "load":
            model = actuator(**self._parts())
        elif self.load == "hand":
            raise ModelError(
                "a hand moves as it will, and with the torque sensor between motor and brake its "
                "torque is not measured: no model can follow such a log; put the sensor at the load"
            )
        else:
            model = actuator(**self._parts(), load=self.load, sensor=self.sensor)
        own = {k: v for k, v in self.parameters.items() if k in model.parameter_names}
        return _with_values(model, own)

    def _parts(self) -> dict[str, Any]:
        return {
            "driver_motor": self.driver_motor,
            "driver_brake": self.driver_brake,
            "hysteresis": self.hysteresis,
            "exponent": self.exponent,
            "smooth": self.smooth,
            "friction": self.friction,
            "parameters": self.parameter_set,
        }


def state_sizes(plant: ProcessModel) -> FloatArray:
    """Magnitude that matters of each of the plant's states, (n_states,)."""
    values = dict(zip(plant.parameter_names, plant.nominal, strict=True))
    # The hysteresis variable at which each of the models slides.
    sliding = 1.0
    if "A" in values:
        sliding = _ratio(values["A"], values["beta"] + values["gamma"])
    elif "zeta" in values:
        sliding = _ratio(1.0, values["zeta"])
    return np.array([_SIZES.get(name, sliding) for name in plant.state_names])


def _ratio(a: float, b: float) -> float:
    """a / b, or 1 for a brake that never slides."""
    return a / b if a > 0.0 and b > 0.0 else 1.0


def _with_values(model: ProcessModel, values: dict[str, float]) -> ProcessModel:
    for name, value in values.items():
        model.parameter(name)
        if not math.isfinite(value):
            raise ModelError(f"parameter {name}: {value} is not a finite number")
        try:
            model = model.with_parameters(**{name: {"nominal": value}})
        except ModelError as error:
            text, named = str(error), f"parameter {name}:"
            raise ModelError(text if text.startswith(named) else f"{named} {text}") from None
    for constraint in model.constraints:
        if constraint.function(tuple(model.nominal)) > 0.0:
            raise ModelError(f"the plant's parameters violate {constraint.text}")
    return model
