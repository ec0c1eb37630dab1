"""A PID controller for sampled loops, its gains, and a reference that rises slowly."""

import math
from typing import Annotated

from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds, Unit


class PidGains(Section):
    """Gains of a loop from an error to volts; a protocol declares their units in a subclass."""

    proportional: float = Field(ge=0.0, description="volts per unit of error")
    integral: float = Field(0.0, ge=0.0, description="volts per second and unit of error")
    derivative: float = Field(0.0, ge=0.0, description="volts per unit of the measurement's rate")
    derivative_filter: Seconds = Field(
        0.005, ge=0.0, le=10.0, description="time constant of the derivative's low-pass filter"
    )


class VelocityGains(PidGains):
    """Gains of a velocity loop."""

    proportional: Annotated[float, Unit("V*s/rad")] = Field(ge=0.0, description="proportional gain")
    integral: Annotated[float, Unit("V/rad")] = Field(0.0, ge=0.0, description="integral gain")
    derivative: Annotated[float, Unit("V*s^2/rad")] = Field(
        0.0, ge=0.0, description="derivative gain, on the measured velocity"
    )


class Pid:
    """PID with limited output, in volts.

    u = K_p e + K_i ∫ e dt - K_d dy/dt + feedforward, with e = reference - y. The derivative is of
    the measurement alone, so that a step of the reference does not kick, by backward differences
    behind a first-order low-pass filter (Åström & Hägglund, "PID Controllers: Theory, Design, and
    Tuning", 1995). Against windup the integral goes no further than the limit that the error
    drives the output to (conditional integration). It starts without a bump: the first output is
    ``start``, whatever the error, if there is an integral to take the difference up.
    """

    def __init__(self, gains: PidGains, lowest: float, highest: float, start: float = 0.0) -> None:
        self._proportional = gains.proportional
        self._integral_gain = gains.integral
        self._derivative_gain = gains.derivative
        self._filter = gains.derivative_filter
        self._lowest, self._highest = lowest, highest
        self._start = start
        self._time = math.nan
        self._measured = self._integral = self._derivative = 0.0

    def output(
        self, time: float, reference: float, measured: float, feedforward: float = 0.0
    ) -> float:
        """Volts that answer a measurement at ``time`` [s], which rises from call to call."""
        error = reference - measured
        elapsed = time - self._time
        if not elapsed > 0.0:  # the first call
            return self._begin(time, error, measured, feedforward)
        weight = self._filter + elapsed
        rate = (measured - self._measured) / weight
        self._derivative = self._filter / weight * self._derivative + rate
        self._time, self._measured = time, measured
        rest = self._proportional * error - self._derivative_gain * self._derivative + feedforward
        volts = rest + self._integral
        step = self._integral_gain * elapsed * error
        # The integral goes on as far as the limit that it drives to, and no further.
        if step > 0.0:
            step = min(step, max(self._highest - volts, 0.0))
        else:
            step = max(step, min(self._lowest - volts, 0.0))
        self._integral += step
        return min(max(volts + step, self._lowest), self._highest)

    def _begin(self, time: float, error: float, measured: float, feedforward: float) -> float:
        self._time, self._measured = time, measured
        rest = self._proportional * error + feedforward
        if self._integral_gain > 0.0:
            self._integral = self._start - rest
        return min(max(rest + self._integral, self._lowest), self._highest)


class Ramp:
    """A reference that follows its target no faster than ``slope`` per second."""

    def __init__(self, slope: float, value: float = 0.0) -> None:
        self.value = value
        self._slope = slope

    def towards(self, target: float, elapsed: float) -> float:
        """The reference ``elapsed`` seconds later."""
        most = self._slope * elapsed
        self.value += min(max(target - self.value, -most), most)
        return self.value
