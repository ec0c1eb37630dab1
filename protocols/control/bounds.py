"""Bounds of the commands that a controller confines itself to."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from daq.config.units import Volts
from daq.hal import FloatArray

MotorLimit = Annotated[
    Volts, Field(gt=0.0, le=10.0, description="largest motor command, either way")
]
MOTOR_LIMIT = 4.5  # V


def command_bounds(
    motor_limit: float, brake_commands: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest commands of motor and brake, (2,) each [V]; zero is within them."""
    return (
        np.array([-motor_limit, min(0.0, *brake_commands)]),
        np.array([motor_limit, max(0.0, *brake_commands)]),
    )
