"""Which part of a torque the motor gives and which the brake, in closed form.

The shaft's torque is T = K i_m + b i_b with i_b >= 0. The slope b = dT/di_b follows from the state
of the brake's hysteresis: it is against the motion where the brake slides, and passes zero with the
hysteresis variable where the motion turns round. So a brake that only dissipates is asked for
exactly what it can give, and its current comes and goes with b, continuously: nothing chatters at
rest. The formulas stand in ``haptics.laws``.
"""

from dataclasses import dataclass
from typing import Literal

from haptics import laws

Preference = Literal["motor", "heating", "stiction"]
_NUMBERS: dict[Preference, int] = {
    "motor": laws.BY_MOTOR,
    "heating": laws.BY_HEATING,
    "stiction": laws.BY_STICTION,
}


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

    @property
    def constants(self) -> list[float]:
        """The first constants of a law."""
        return [_NUMBERS[self.preference], self.constant, *self.resistances, *self.limits]
