"""A lithium cell by its equivalent circuit: a resistance, and one beside a capacitance.

The open-circuit voltage goes straight with the charge over the part that is used; the capacity is
known (Plett, "Battery Management Systems", vol. 1, 2015).
"""

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"rest": 3.45, "slope": 0.62, "ohmic": 0.032, "slow": 0.021, "lag": 35.0}
SAMPLE_TIME = 1.0  # s
LEVELS = (-4.0, 6.0)  # A, drawn
HOLD = 50
CAPACITY = 2.5 * 3600.0  # A*s
START = 0.7  # of it


def derivative(x, u, p):
    _charge, over = x
    _rest, _slope, _ohmic, slow, lag = p
    return (-u[0] / CAPACITY, (slow * u[0] - over) / lag)


def output(x, u, p):
    charge, over = x
    rest, slope, ohmic, _slow, _lag = p
    return (rest + slope * (charge - 0.5) - ohmic * u[0] - over,)


model = ProcessModel(
    name="battery",
    description="lithium cell, one pair of resistance and capacitance",
    states=(State("charge", "1", initial=START), State("over", "V")),
    inputs=(Input("current", "A", "zoh"),),
    outputs=(Output("voltage", "V"),),
    parameters=(
        Parameter("rest", "V", 3.5, 3.0, 4.0),
        Parameter("slope", "V", 0.5, 0.05, 2.0, "log"),
        Parameter("ohmic", "ohm", 0.05, 5e-3, 0.5, "log"),
        Parameter("slow", "ohm", 0.05, 2e-3, 0.5, "log"),
        Parameter("lag", "s", 20.0, 2.0, 200.0, "log"),
    ),
    derivative=derivative,
    output=output,
)
