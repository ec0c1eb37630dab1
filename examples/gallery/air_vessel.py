"""A vessel that a valve fills from the mains and vents into the room; it leaks.

Isothermal, through orifices that may flow at the speed of sound. The valve's opening is positive
towards the mains, negative towards the room.
"""

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.problem.shapes import orifice

TRUTH = {"filling": 0.35, "venting": 0.55, "leak": 0.02}
SAMPLE_TIME = 0.05  # s
LEVELS = (-1.0, 1.0)
HOLD = 20
MAINS, ROOM = 7.0, 1.0  # bar, absolute


def derivative(x, u, p):
    (pressure,) = x
    filling, venting, leak = p
    opening, shutting = max(u[0], 0.0), max(-u[0], 0.0)
    flow_in = filling * opening * orifice(MAINS, pressure)
    return (flow_in - (venting * shutting + leak) * orifice(pressure, ROOM),)


model = ProcessModel(
    name="air_vessel",
    description="air vessel behind a valve",
    states=(State("pressure", "bar", initial=ROOM),),
    inputs=(Input("opening", "1", "zoh"),),
    outputs=(Output("pressure", "bar"),),
    parameters=(
        Parameter("filling", "1/s", 0.3, 0.03, 3.0, "log"),
        Parameter("venting", "1/s", 0.3, 0.03, 3.0, "log"),
        Parameter("leak", "1/s", 0.03, 1e-3, 0.3, "log"),
    ),
    derivative=derivative,
)
