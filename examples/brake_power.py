"""A limit of one's own: the heat that the brake has to carry away.

Named in a rig's file:

    limits:
      own:
        - use: brake_power.py:BrakePower
          options: {most: 20 W, over: 0.5 s}
"""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Unit
from daq.limits import Limit


class Options(Section):
    """Settings of the limit, with bounds and units like all others."""

    most: Annotated[float, Unit("W")] = Field(gt=0.0, description="largest power on average")
    over: Seconds = Field(0.5, gt=0.0, description="time of the average")


class BrakePower(Limit):
    """Mechanical power |torque omega|, averaged by a first-order lag, below a limit."""

    Options = Options

    def __init__(self, options):
        self.options = options
        self.average = 0.0

    def begin(self, phase, sample_rate):
        """A phase begins; the lag keeps its state."""
        self.forget = math.exp(-1.0 / (self.options.over * sample_rate))

    def check(self, samples):
        """The first sample in which the average is beyond the limit, and why."""
        for row, power in enumerate(np.abs(samples.torque * samples.omega).tolist()):
            self.average = self.forget * self.average + (1.0 - self.forget) * power
            if self.average > self.options.most:
                return row, (
                    f"the brake takes {self.average:.3g} W on average, "
                    f"beyond its limit of {self.options.most:g} W"
                )
        return None
