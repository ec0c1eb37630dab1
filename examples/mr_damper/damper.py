"""A linear magnetorheological damper, as a process model of one's own.

A fluid that creeps at small stress and flows by a power law at large (Herschel-Bulkley) sits in
series with the stiffness of rod, joints and fluid column; the gas accumulator is a soft spring
beside them. Nine parameters, one set for all currents.

The damper itself reverses its force within a few tenths of a millimetre of travel. The records
this was written for had been smoothed over a tenth of the period, which spreads each reversal in
proportion to the speed of the motion; creep in proportion to the recent speed stands in for
that (``width``, ``memory``). For records that were not smoothed fix ``width`` at 0.
"""

from sysid import Input, Output, Parameter, ProcessModel, State

FLOW_SPEED = 0.05  # m/s, the piston speed at which the fluid carries its yield force (z = 1)


def yield_force(current, off, gain, saturation):
    return off + gain * current / (1.0 + current / saturation)


def derivative(x, u, p):
    _, z, recent_speed = x
    velocity, current = u
    off, gain, saturation, stiffness, _, _, creep, width, memory = p
    speed = abs(velocity)
    z2 = z * z
    flow = (creep + width * recent_speed) * z + FLOW_SPEED * z2 * z2 * z2 * z
    return (
        velocity,
        stiffness / yield_force(current, off, gain, saturation) * (velocity - flow),
        speed / memory * (speed - recent_speed),
    )


def output(x, u, p):
    displacement, z, _ = x
    _, current = u
    off, gain, saturation, _, spring, spring_gain, _, _, _ = p
    fluid = yield_force(current, off, gain, saturation) * z
    return (fluid + (spring + spring_gain * current) * displacement,)


def between(lower, upper, description):
    """A wide range, searched by logarithm."""
    return {
        "nominal": (lower * upper) ** 0.5,
        "lower": lower,
        "upper": upper,
        "scale": "log",
        "description": description,
    }


model = ProcessModel(
    name="mr_damper",
    description="linear magnetorheological damper",
    states=(
        State("displacement", "m", description="piston displacement from where the record starts"),
        State("z", "1", description="stress of the fluid as a share of its yield stress"),
        State("recent_speed", "m/s", description="mean speed over the last stretch of travel"),
    ),
    inputs=(
        Input("velocity", "m/s", "foh", "piston velocity"),
        Input("current", "A", "zoh", "coil current, not negative"),
    ),
    outputs=(Output("force", "N", "force on the piston, positive with positive velocity"),),
    # Read off the loops: forces of 200 N without current and 1500 N at 1 A, which turn round
    # within 0.15 to 5 mm of travel; plateaus tilted by 2 to 250 N over 25 mm.
    parameters=(
        Parameter("yield_off", "N", **between(40.0, 800.0, "yield force without current")),
        Parameter("gain", "N/A", **between(300.0, 6000.0, "its rise with a small current")),
        Parameter("saturation", "A", **between(0.5, 20.0, "current that halves that rise")),
        Parameter(
            "stiffness", "N/m", **between(3e5, 1e7, "rod, joints and fluid column before yield")
        ),
        Parameter("spring", "N/m", **between(1e2, 1e4, "accumulator, without current")),
        Parameter("spring_gain", "N/(m*A)", **between(1e2, 1e4, "its rise with current")),
        Parameter("creep", "m/s", **between(1e-3, 5e-2, "speed of linear creep at z = 1")),
        Parameter("width", "1", **between(5e-2, 2.0, "creep added per recent speed")),
        Parameter("memory", "m", **between(3e-4, 3e-2, "travel over which speed is recent")),
    ),
    derivative=derivative,
    output=output,
)
