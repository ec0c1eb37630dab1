"""Torque against velocity: a staircase of constant velocities at each of several brake commands."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from daq.config.units import RadiansPerSecond, Seconds, Turns, Unit, Volts
from daq.experiment import Controller, Family, FreeSetting, Plan, RunFrame
from daq.findings import Findings
from daq.hal import FloatArray, Samples
from protocols.analysis.plateau_findings import PlateauFindings
from protocols.analysis.torque_curve import Motor, levels_of
from protocols.control.loop import BRAKE_SLOPE, VelocityLoop, command_bounds
from protocols.control.staircase import Plateau, SettlingTest, Staircase, longest, quickest

_OVERSPEED = 1.5  # of the fastest velocity asked for: beyond it something is wrong
_SPEED_MARGIN = 10.0  # rad/s, the same for slow velocities
# Of a design: number of velocities, the slowest [rad/s], the fastest in parts of the rig's limit,
# shares of a run for the ramps, the brake's ramp at most, and settling at each velocity.
_VELOCITIES, _SLOWEST, _FASTEST, _RAMPS, _BRAKING, _SETTLING = 3, 0.5, 0.6, (0.03, 0.5), 0.3, 0.05


class ConstantVelocity(VelocityLoop):
    """Velocity loop on the motor; torque against velocity at each brake command."""

    columns: ClassVar[Mapping[str, str]] = {
        "omega_ref": "rad/s",
        "omega_tracked": "rad/s",  # from the angle
        "plateau": "1",  # from 0, -1 behind the last
        "settled": "1",  # while the velocity is being measured
    }

    velocities: list[RadiansPerSecond] = Field(
        min_length=1, max_length=200, description="visited in this order; negative turns backwards"
    )
    brake_commands: list[Volts] = Field(
        min_length=1, max_length=50, description="at each of which all velocities are visited"
    )
    slope: Annotated[float, Unit("rad/s^2")] = Field(
        200.0, gt=0.0, le=1e5, description="of the ramps from a velocity to the next"
    )
    measure: Seconds = Field(
        4.0, gt=0.0, le=3600.0, description="time at every velocity once it has settled"
    )
    turns: Turns = Field(
        1.0, ge=0.0, le=1000.0, description="turns measured at least, however slow"
    )
    settling: SettlingTest = Field(SettlingTest(), description="when a velocity counts as settled")
    fit_from: RadiansPerSecond = Field(
        0.0,
        ge=0.0,
        le=1e4,
        description="speed from which plateaus count for c0 and c1; slower ones are only shown",
    )

    @classmethod
    def family(cls, frame: RunFrame) -> Family | None:
        """Some velocities at a brake command, with any ramps and gains, on a shaft that is free."""
        shaft = cls.driven_shaft(frame)
        if shaft is None or not shaft.endless:
            return None
        fastest, time = _FASTEST * shaft.speed, frame.seconds - 2.0 / frame.sample_rate
        strongest = min(frame.brake[1], _BRAKING * time * BRAKE_SLOPE)
        free = {
            **{
                f"velocity_{k}": FreeSetting(-fastest, fastest, calm=0.0)
                for k in range(_VELOCITIES)
            },
            "brake": FreeSetting(0.0, strongest, calm=0.0),
            "ramps": FreeSetting(*_RAMPS),
            **cls.loop_settings(frame),
        }

        def content(values: Mapping[str, float]) -> dict[str, Any]:
            drawn = [values[f"velocity_{k}"] for k in range(_VELOCITIES)]
            velocities = [math.copysign(max(abs(v), _SLOWEST), v) for v in drawn]
            ways = np.abs(np.diff([0.0, *velocities, 0.0])).sum()
            ramps, settling = values["ramps"] * time, _SETTLING * time
            held = time - ramps - values["brake"] / BRAKE_SLOPE - (_VELOCITIES + 1) * settling
            return {
                **cls.loop_keys(values, frame, shaft),
                "velocities": velocities,
                "brake_commands": [values["brake"]],
                "slope": float(ways) / ramps,
                "measure": held / _VELOCITIES,
                "turns": 0.0,
                "settling": {"time": 0.0, "timeout": settling},
            }

        return Family(free, content)

    @property
    def plateaus(self) -> tuple[Plateau, ...]:
        """All steps of the staircase, in order."""
        return tuple(
            Plateau(v, brake, max(self.measure, self.turns * 2.0 * math.pi / abs(v)))
            for brake in self.brake_commands
            for v in self.velocities
        )

    def plan(self) -> Plan:
        """The longest that it can take, the bounds of its commands, and how far the shaft turns."""
        self._check()
        visits = self.plateaus, self.settling, self.slope
        seconds = longest(*visits)
        n_samples = self.samples_in(seconds, "measure")
        velocity, brake = quickest(*visits, self.sample_rate)
        bounds = command_bounds(self.motor_limit, self.brake_commands)
        references = {"omega_ref": velocity, "cmd_voltage_brake": brake}
        duration = (
            f"It takes {len(velocity) / self.sample_rate:.4g} s if every velocity settles at once, "
            f"{seconds:.4g} s at most."
        )
        remarks = (duration, self._travel(), self._strength())
        return Plan(n_samples, *bounds, references=references, remarks=remarks)

    def controller(self) -> Controller:
        """The staircase's loop."""
        fastest = _OVERSPEED * self._fastest + _SPEED_MARGIN
        servo = self.servo(fastest, ", and look what drives the shaft if not")
        return Staircase(self.plateaus, self.settling, servo, self.motor_limit, self.slope)

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings:
        """The torque on each settled plateau, c0 and c1, and what recurs with every turn."""
        plateaus = self.plateaus
        levels = levels_of(samples, extra, plateaus)
        if not levels:
            raise ValueError(
                "no plateau has settled: look at omega_tracked beside omega_ref in log.csv. A load "
                "on the shaft ends its travel; a brake stronger than the motor holds it"
            )
        motor = None
        if self.torque_sensor == "load" and self.ratings.torque_constant is not None:
            motor = Motor(self.ratings.torque_constant, self.ratings.motor_damping)
        return PlateauFindings(levels, plateaus, motor, self.fit_from, samples, extra).findings()

    @property
    def _fastest(self) -> float:
        return max(map(abs, self.velocities))

    def _check(self) -> None:
        self.require_torque_constant()
        for velocity in self.velocities:
            if velocity == 0.0 or not math.isfinite(velocity):
                raise ValueError(
                    f"velocities: {velocity:g} rad/s is no velocity at which a shaft turns; "
                    "leave it out"
                )
        if self.homing.turns > 0.0:
            raise ValueError(
                "homing.turns: this winds a load, which the staircase would wind off and on again; "
                "take the load off the shaft and leave homing out"
            )
        self.require_strength(self.brake_commands)

    def _travel(self) -> str:
        """How far the shaft turns at most."""
        timeout = self.settling.timeout
        travel = sum(abs(step.velocity) * (step.measure + timeout) for step in self.plateaus)
        return (
            f"The shaft turns at up to {self._fastest:g} rad/s, up to "
            f"{travel / (2.0 * math.pi):.0f} turns in all: take the load off, and keep hands away."
        )

    def _strength(self) -> str:
        """What the strongest brake takes of the motor."""
        needed = self.holding_command(self.brake_commands)
        if needed is None:
            return (
                "Whether the motor can turn the strongest brake is not known: give "
                "ratings.torque_constant and ratings.brake_constant to have it checked."
            )
        return (
            f"The brake at {max(self.brake_commands):g} V takes about {needed:.2f} V of the motor "
            f"by its ratings; its limit here is {self.motor_limit:g} V."
        )
