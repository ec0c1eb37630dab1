"""Which part of a torque the motor gives and which the brake, in closed form.

The shaft's torque is T = K i_m + b i_b with i_b >= 0. The slope b = dT/di_b follows from the state
of the brake's hysteresis: it is against the motion where the brake slides, and passes zero with the
hysteresis variable where the motion turns round. So a brake that only dissipates is asked for
exactly what it can give, and its current comes and goes with b, continuously: nothing chatters at
rest.
"""

from dataclasses import dataclass
from typing import Literal

Preference = Literal["motor", "heating", "stiction"]


@dataclass(frozen=True)
class Allocation:
    """How a torque is shared.

    motor: the brake stays off. heating: of all pairs of currents that give the torque the one that
    minimises R_m i_m^2 + R_b i_b^2 (Lagrange: i_m = m K / R_m, i_b = m b / R_b where that is
    positive). stiction: the brake gives only what the motor cannot. constant: K [N*m/A].
    resistances [ohm], limits [A]: of motor and brake.
    """

    preference: Preference
    constant: float
    resistances: tuple[float, float]
    limits: tuple[float, float]

    def brake(self, torque: float, slope: float) -> float:
        """The brake's current [A] for a torque [N*m] at a slope [N*m/A]."""
        limit_m, limit_b = self.limits
        if self.preference == "motor" or torque * slope <= 0.0:
            return 0.0
        most = abs(self.constant) * limit_m
        # What is beyond the motor is the brake's under any preference. Where an ampere of it gives
        # less than one of the motor, it fades out: the current has no jump where b passes zero.
        reach = limit_b * min(abs(slope / self.constant), 1.0)
        least = min((abs(torque) - most) / abs(slope), reach) if abs(torque) > most else 0.0
        if self.preference == "stiction":
            return least
        R_m, R_b = self.resistances
        shared = torque / (self.constant**2 / R_m + slope**2 / R_b) * slope / R_b
        return min(max(shared, least), limit_b)

    def motor(self, torque: float) -> float:
        """The motor's current [A] for what is left to it [N*m]."""
        limit = self.limits[0]
        return min(max(torque / self.constant, -limit), limit)
