"""The rig's configuration: which backend, which calibration, which limits."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, create_model, field_validator

from daq.config.base import Section
from daq.config.units import Amperes, Unit, Volts

Sign = Literal[-1, 1]


class AnalogInput(Section):
    """Volts at an input to SI units: value = sign * scale * (volts - offset)."""

    sign: Sign = Field(1, description="-1 turns the direction round")


class CurrentInput(AnalogInput):
    """A current sensor's volts."""

    scale: Annotated[float, Unit("A/V")] = Field(gt=0.0, description="amperes per volt")


class TorqueInput(AnalogInput):
    """A torque bridge's volts."""

    scale: Annotated[float, Unit("N*m/V")] = Field(gt=0.0, description="torque per volt")


class Encoder(Section):
    """Quadrature encoder: four counts per cycle."""

    cycles: int = Field(2048, ge=1, le=1_000_000, description="cycles per revolution")
    sign: Sign = Field(1, description="-1 turns the direction round")


class Sensors(Section):
    """Calibration of every measured channel; the only place where volts become SI units."""

    current_motor: CurrentInput = Field(
        CurrentInput(scale=0.5), description="motor current sense (0.5 A/V is 2 V/A)"
    )
    current_brake: CurrentInput = Field(
        CurrentInput(scale=0.5), description="brake current sense (0.5 A/V is 2 V/A)"
    )
    torque: TorqueInput = Field(
        TorqueInput(scale=0.706), description="torque bridge (3.53 N*m at 5 V is 0.706 N*m/V)"
    )
    encoder: Encoder = Field(Encoder(), description="shaft encoder")


class CommandLimits(Section):
    """Range of each command [V at the amplifier input]; beyond it the range's end is applied."""

    motor: tuple[Volts, Volts] = Field((-5.0, 5.0), description="lowest and highest motor command")
    brake: tuple[Volts, Volts] = Field(
        (0.0, 0.38),
        description="lowest and highest brake command (at 0.5 A/V, 0.38 V give 0.19 A)",
    )

    @field_validator("motor", "brake")
    @classmethod
    def _ordered(cls, limits: tuple[float, float]) -> tuple[float, float]:
        low, high = limits
        if low >= high:
            raise ValueError(f"low end {low:g} is not below high end {high:g}; write [low, high]")
        if not low <= 0.0 <= high:
            raise ValueError("the range must include 0 V, to which the outputs are made safe")
        return limits


class CurrentLimits(Section):
    """Measured current at which the run is stopped and the outputs zeroed [A]."""

    motor: Amperes = Field(2.4, gt=0.0, le=10.0, description="largest motor current")
    brake: Amperes = Field(0.19, gt=0.0, le=10.0, description="largest brake current")


class Limits(Section):
    """What keeps the rig and the hand on it whole."""

    command: CommandLimits = Field(CommandLimits(), description="clamps of the commands")
    current: CurrentLimits = Field(CurrentLimits(), description="current interlocks")


class RigConfig(Section):
    """A rig: the backend that talks to it, its calibration and its limits."""

    name: str = Field("rig", min_length=1, max_length=80, description="shown in captures")
    backend: str = Field("simulated", min_length=1, description="name of an installed backend")
    options: Any = Field(default_factory=dict, description="the backend's own settings")
    sensors: Sensors = Field(Sensors(), description="calibration of the measured channels")
    limits: Limits = Field(Limits(), description="clamps and interlocks")


def with_options(options: type[Section]) -> type[RigConfig]:
    """The configuration of a rig whose backend has these options."""
    field = Field(default_factory=options, description="the backend's own settings")
    return create_model("RigConfig", __base__=RigConfig, options=(options, field))
