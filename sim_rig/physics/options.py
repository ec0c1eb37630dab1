"""The choices from which an actuator is put together, each with what it means.

The same types stand in the call ``actuator(...)``, in a rig's YAML and in ``rig models``.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from daq.config.units import Part

DriverKind = Literal["closed", "open"]
MotorDriver = Annotated[
    DriverKind,
    Field(description="motor amplifier: closed controls its current, open gives a voltage"),
]
BrakeDriver = Annotated[DriverKind, Field(description="brake amplifier: likewise")]
MotorOrder = Annotated[int, Field(ge=1, le=3, description="order of the motor amplifier")]
BrakeOrder = Annotated[int, Field(ge=1, le=3, description="order of the brake amplifier")]
MotorOutputResistance = Annotated[
    bool, Field(description="output resistance of the motor amplifier; only its sum with R_m acts")
]
BrakeOutputResistance = Annotated[
    bool, Field(description="output resistance of the brake amplifier; only its sum with R_b acts")
]
Hysteresis = Annotated[
    Literal["bouc-wen", "dahl", "lugre"], Field(description="hysteresis model of the brake")
]
Exponent = Annotated[Part, Field(ge=1.0, le=50.0, description="n of the Bouc-Wen hysteresis")]
Smooth = Annotated[
    bool, Field(description="tanh(rho x) in place of the hysteresis's signs: differentiable")
]
Friction = Annotated[
    Literal["none", "stribeck", "cyclic"],
    Field(description="brushes of the torque sensor; cyclic: unevenly worn along a turn"),
]
Load = Annotated[
    Literal["measured", "free", "locked", "pulley", "hand", "pulley+hand"],
    Field(description="what is on the shaft; measured: a torque known from a sensor"),
]
PlantLoad = Annotated[
    Literal["free", "locked", "pulley", "hand"], Field(description="what is on the shaft")
]
Sensor = Annotated[
    Literal["load", "between"],
    Field(description="torque sensor at the load, or between motor and brake"),
]
Limits = Annotated[bool, Field(description="ends of the amplifiers' range: 24 V, 2.5 A")]
Turns = Annotated[
    float, Field(ge=0.0, le=1000.0, description="turns of a pulley's cable wound up at the start")
]
ParameterSet = Annotated[
    Literal["nominal", "rig", "A", "B", "C", "D"],
    Field(
        description="values: nominal for a search, of the simulated rig, or of a row of the "
        "thesis's table 4.1"
    ),
]


@dataclass(frozen=True)
class Design:
    """The choices of one actuator, as ``actuator`` takes them."""

    driver_motor: MotorDriver = "closed"
    driver_brake: BrakeDriver = "closed"
    order_motor: MotorOrder = 1
    order_brake: BrakeOrder = 1
    output_resistance_motor: MotorOutputResistance = False
    output_resistance_brake: BrakeOutputResistance = False
    hysteresis: Hysteresis = "bouc-wen"
    exponent: Exponent = 1.0
    smooth: Smooth = False
    friction: Friction = "none"
    load: Load = "measured"
    sensor: Sensor = "load"
    limits: Limits = False
