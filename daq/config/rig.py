"""The rig's configuration: which backend, which calibration, which limits."""

import math
from collections.abc import Callable
from operator import itemgetter
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, ValidationInfo, create_model, field_validator

from daq.config.base import Section
from daq.config.units import (
    Amperes,
    NewtonMetres,
    Part,
    RadiansPerSecond,
    Seconds,
    Turns,
    Unit,
    Volts,
)
from daq.errors import ConfigError, Mistake

Sign = Literal[-1, 1]
Realtime = Literal["off", "prefer", "require"]
VoltsPerSecond = Annotated[float, Unit("V/s")]
AmperesPerVolt = Annotated[float, Unit("A/V")]
Position = Annotated[Turns, Field(ge=-1e4, le=1e4)]
SquaredCurrentTime = Annotated[float, Unit("A^2*s")]

_SLOW = 0.1  # of the speed limit, up to which the motor's back EMF leaves its amplifier voltage
_FASTEST = 100.0  # rad/s, taken where there is no such limit
_INPUT = 10.0  # V, where an analog input ends at the latest
_UNLOADED = 2.0  # times the speed with half of the current: where none is left, at most
COUNT_GRAIN = 2.0  # counts by which a change of the encoder's may be larger than the shaft's


class AnalogInput(Section):
    """Volts at an input to SI units: value = sign * scale * (volts - offset)."""

    sign: Sign = Field(1, description="-1 turns the direction round")


class CurrentInput(AnalogInput):
    """A current sensor's volts."""

    scale: Annotated[float, Unit("A/V")] = Field(gt=0.0, description="amperes per volt")


class TorqueInput(AnalogInput):
    """A torque bridge's volts; between motor and brake it is compared with the motor's current."""

    scale: Annotated[float, Unit("N*m/V")] = Field(gt=0.0, description="torque per volt")
    motor_constant: Annotated[float, Unit("N*m/A")] | None = Field(
        None,
        gt=0.0,
        description="torque per ampere of the motor, roughly, of a sensor between motor and brake; "
        "left out: not compared",
    )


class Encoder(Section):
    """Quadrature encoder: four counts per cycle."""

    cycles: int = Field(2048, ge=1, le=1_000_000, description="cycles per revolution")
    sign: Sign = Field(1, description="-1 turns the direction round")
    speed: Literal["edges", "auto"] = Field(
        "auto",
        description="what makes omega: edges is the time between counts, of the last one or of all "
        "of a sample as in the reference firmware, which the log shows; auto looks whether a log's "
        "slow motion shows that; fast logs do not",
    )

    @property
    def count(self) -> float:
        """Angle of a count [rad], with the sign."""
        return self.sign * 2.0 * math.pi / (4.0 * self.cycles)


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
        (0.0, 0.38), description="lowest and highest brake command (at 0.5 A/V, 0.38 V give 0.19 A)"
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


class SlewLimits(Section):
    """Fastest change of each command; none where a key is left out.

    A plan that is faster is refused; a controller's command follows no faster.
    """

    motor: VoltsPerSecond | None = Field(None, gt=0.0, description="fastest motor command")
    brake: VoltsPerSecond | None = Field(None, gt=0.0, description="fastest brake command")


class CurrentLimits(Section):
    """Measured current at which the run is stopped and the outputs zeroed."""

    motor: Amperes = Field(2.4, gt=0.0, le=10.0, description="largest motor current")
    brake: Amperes = Field(0.21, gt=0.0, le=10.0, description="largest brake current")


class Overload(Section):
    """What a winding's heat allows: a current for ever, and so much i^2 t above it."""

    continuous: Amperes = Field(gt=0.0, le=10.0, description="current that may flow for ever")
    budget: SquaredCurrentTime = Field(
        gt=0.0,
        le=1e6,
        description="i^2 t above the continuous current; a current i lasts "
        "budget / (i^2 - continuous^2)",
    )


class OverloadLimits(Section):
    """i^2 t of each channel; not watched where a key is left out."""

    motor: Overload | None = Field(None, description="of the motor's winding")
    brake: Overload | None = Field(None, description="of the brake's coil")


class Stall(Section):
    """What must turn the shaft: a motor current, more of it against the brake, and for how long."""

    motor: Amperes = Field(
        gt=0.0, description="motor current that turns the shaft and its load, brake off"
    )
    brake: Amperes = Field(
        0.03, gt=0.0, description="brake current that takes as much motor current again"
    )
    time: Seconds = Field(
        0.05, gt=0.0, description="for which the shaft may stand still; at twice the current half"
    )


class EncoderLimits(Section):
    """What an encoder that works cannot show."""

    fastest: RadiansPerSecond = Field(
        1000.0,
        gt=0.0,
        le=1e4,
        description="change of the angle from sample to sample that is a jump",
    )
    silent: Turns = Field(
        0.25, gt=0.0, description="turns by which count and speed estimate may come to differ"
    )
    stall: Stall | None = Field(None, description="current that turns it; left out: not watched")
    acceleration: Annotated[float, Unit("rad/s^2/A")] | None = Field(
        None,
        gt=0.0,
        description="of the shaft without load by an ampere of the motor, at most; needs stall; "
        "left out: not watched",
    )

    @field_validator("acceleration")
    @classmethod
    def _has_stall(cls, acceleration: float | None, info: ValidationInfo) -> float | None:
        if acceleration is not None and info.data.get("stall") is None:
            raise ValueError("it needs encoder.stall, which tells the friction; write that as well")
        return acceleration


class UserLimit(Section):
    """A limit of a user's own."""

    use: str = Field(min_length=1, description="name of an installed limit, or FILE.py:CLASS")
    options: dict[str, Any] = Field(default_factory=dict, description="the limit's own settings")
    # Makes a new limit for a run; set where the name has been looked up.
    _make: Callable[[], Any] | None = PrivateAttr(default=None)

    def make(self) -> Any:
        """A new limit for one run."""
        if self._make is None:
            problem = f"{self.use} has not been looked up"
            raise ConfigError(problem, cure="load the rig's file", key="limits.own")
        return self._make()


class LimitSettings(Section):
    """What keeps the rig and the hand on it whole; docs/safety.md tells each."""

    command: CommandLimits = Field(CommandLimits(), description="clamps of the commands")
    slew: SlewLimits = Field(SlewLimits(), description="how fast the commands may change")
    current: CurrentLimits = Field(CurrentLimits(), description="current interlocks")
    i2t: OverloadLimits = Field(OverloadLimits(), description="heat of the windings")
    speed: RadiansPerSecond | None = Field(
        None, gt=0.0, le=1e4, description="fastest shaft, either way"
    )
    torque: NewtonMetres | None = Field(
        None, gt=0.0, le=1e3, description="largest torque, either way"
    )
    travel: tuple[Position, Position] | None = Field(
        None, description="lowest and highest angle, from where the shaft stood at the beginning"
    )
    winding: Turns | None = Field(
        None,
        ge=0.0,
        description="turns that must stay wound up after homing; left out where nothing unwinds",
    )
    encoder: EncoderLimits = Field(EncoderLimits(), description="what the encoder cannot show")
    frozen: Seconds | None = Field(
        0.1,
        gt=0.0,
        description="for which an input with noise, or one that must follow its command, may "
        "read the same to the bit; null: not watched",
    )
    lost: Part = Field(
        0.01, ge=0.0, le=1.0, description="share of a run's samples that may be missing in its log"
    )
    late: Seconds = Field(
        0.5, gt=0.0, description="for which a device may hold a command because none arrives"
    )
    own: list[UserLimit] = Field(default_factory=list, description="limits from your own code")

    @field_validator("travel")
    @classmethod
    def _includes_start(cls, travel: tuple[float, float] | None) -> tuple[float, float] | None:
        if travel is not None and not travel[0] < 0.0 < travel[1]:
            raise ValueError("it counts from where the shaft stands, so it must include 0 turns")
        return travel


class Amplifiers(Section):
    """Current of each amplifier per volt of its command, to check a plan before it runs.

    Left out for one that gives a voltage: what current flows is then not known beforehand.
    """

    motor: AmperesPerVolt | None = Field(None, gt=0.0, description="of the motor's amplifier")
    brake: AmperesPerVolt | None = Field(None, gt=0.0, description="of the brake's amplifier")
    speed: RadiansPerSecond | None = Field(
        None,
        gt=0.0,
        description="up to which the motor's amplifier gives at least half of the current asked "
        "for, against the back EMF; left out: a tenth of limits.speed",
    )


class Mounting(Section):
    """The same rig with something else on its shaft, which a person changes."""

    rig: str = Field(min_length=1, description="rig file that then holds, beside this one")
    plant: str | None = Field(
        None,
        description="model of the whole rig then; default what a simulated rig is",
        examples=["actuator:load=free,limits=true"],
    )


class RigConfig(Section):
    """A rig: the backend that talks to it, its calibration and its limits."""

    name: str = Field("rig", min_length=1, max_length=80, description="shown in captures")
    backend: str = Field(
        "simulated", min_length=1, description="name of a backend, or FILE.py:CLASS"
    )
    options: Any = Field(default_factory=dict, description="the backend's own settings")
    sensors: Sensors = Field(Sensors(), description="calibration of the measured channels")
    amplifiers: Amplifiers = Field(Amplifiers(), description="gain of current-controlled ones")
    limits: LimitSettings = Field(LimitSettings(), description="clamps and interlocks")
    realtime: Realtime = Field(
        "prefer",
        description="real-time scheduling during a run: off, prefer (as far as it is granted), "
        "or require (no run without)",
    )

    mountings: dict[str, Mounting] = Field(
        default_factory=dict,
        description="other ways to mount it, by what a person is told to do; for rig characterise "
        "--ask",
        examples=[{"take the load off the shaft": {"rig": "free.yaml"}}],
    )

    @property
    def slow(self) -> float:
        """Speed [rad/s] up to which the motor's amplifier gives nearly all of what is asked."""
        speed = _SLOW * (self.limits.speed or _FASTEST)
        return min(speed, self.amplifiers.speed or speed)

    @property
    def idle_limits(self) -> list[Mistake]:
        """Limits that nothing which the rig's file describes can pass, and so protect nothing."""
        limits, sensors = self.limits, self.sensors
        mistakes = []
        for key, limit, sensor, unit in (
            ("current.motor", limits.current.motor, "current_motor", "A"),
            ("current.brake", limits.current.brake, "current_brake", "A"),
            ("torque", limits.torque, "torque", "N*m"),
        ):
            most = _INPUT * getattr(sensors, sensor).scale
            if limit is not None and limit > most:
                problem = (
                    f"{limit:g} {unit} is never measured: inputs end at {_INPUT:g} V, which is "
                    f"{most:.4g} {unit} by sensors.{sensor}.scale"
                )
                mistakes.append(Mistake(problem, "write less, or the right scale", key=key))
        speeds = {"limits.encoder.fastest, beyond which the angle jumps": limits.encoder.fastest}
        if self.amplifiers.speed is not None:
            speeds["twice amplifiers.speed, where the motor's supply ends"] = (
                _UNLOADED * self.amplifiers.speed
            )
        name, fastest = min(speeds.items(), key=itemgetter(1))
        if limits.speed is not None and limits.speed > fastest:
            problem = f"{limits.speed:g} rad/s is beyond {fastest:g} rad/s, {name}"
            mistakes.append(Mistake(problem, "write what rig and hand bear", key="speed"))
        return mistakes

    @field_validator("realtime", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        # YAML reads off as a truth value.
        return "off" if value is False else value


def with_options(options: type[Section]) -> type[RigConfig]:
    """The configuration of a rig whose backend has these options."""
    field = Field(default_factory=options, description="the backend's own settings")
    return create_model("RigConfig", __base__=RigConfig, options=(options, field))
