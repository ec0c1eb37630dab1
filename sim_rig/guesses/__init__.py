"""Starting ranges of the actuator's parameters, read from its logs before any search."""

from collections.abc import Sequence

from sim_rig.guesses import damping, electrical
from sim_rig.guesses.ranges import Ranges
from sim_rig.physics.options import Design
from sysid import Guess
from sysid.problem.guesses import Guesses, Known, Measured


def guesses(design: Design) -> Guesses:
    """The function that guesses ranges for an actuator of this design.

    Brush friction or a load that is neither measured nor absent leave the damping unguessed.
    """

    def guess(records: Sequence[Measured], assumed: Known) -> dict[str, Guess]:
        ranges = Ranges(assumed)
        electrical.narrow(
            ranges, records, "motor", design.driver_motor, design.output_resistance_motor
        )
        brake_delay = electrical.narrow(
            ranges, records, "brake", design.driver_brake, design.output_resistance_brake
        )
        if design.friction == "none" and design.load in ("measured", "free"):
            damping.narrow(ranges, records, brake_delay)
        return ranges.guesses

    return guess
