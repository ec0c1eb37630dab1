"""Two tanks, one above the other: a pump fills the upper, which drains into the lower.

Torricelli's law of both outlets; areas are equal (Schoukens et al., "Cascaded tanks benchmark
combining soft and hard nonlinearities", 2016).
"""

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.problem.shapes import signed_root

TRUTH = {"pump": 4.2e-3, "upper": 0.021, "lower": 0.018}
SAMPLE_TIME = 4.0  # s
LEVELS = (1.0, 6.0)  # V, of the pump
HOLD = 40  # samples for which a level is held


def derivative(x, u, p):
    high, low = x
    pump, upper, lower = p
    through = upper * signed_root(high, 1e-3)
    return (pump * u[0] - through, through - lower * signed_root(low, 1e-3))


model = ProcessModel(
    name="two_tanks",
    description="two tanks in series, drained by gravity",
    states=(State("high", "m", initial=0.1), State("low", "m", initial=0.1)),
    inputs=(Input("voltage", "V", "zoh"),),
    outputs=(Output("high", "m"), Output("low", "m")),
    parameters=(
        Parameter("pump", "m/(V*s)", 3e-3, 3e-4, 3e-2, "log", description="level by the pump"),
        Parameter("upper", "m^0.5/s", 0.02, 2e-3, 0.2, "log", description="outlet by area"),
        Parameter("lower", "m^0.5/s", 0.02, 2e-3, 0.2, "log", description="outlet by area"),
    ),
    derivative=derivative,
)
