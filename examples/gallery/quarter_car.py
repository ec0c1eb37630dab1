"""A quarter of a car: wheel and body on a test bench that moves the road.

The damper is harder in rebound than in compression, as those of cars are; the tyre is a spring.
The body's acceleration is measured, and how far the wheel travels (Guglielmino et al., "Semi-active
Suspension Control", 2008).
"""

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"wheel": 38.0, "spring": 17e3, "tyre": 190e3, "compression": 900.0, "rebound": 2200.0}
BODY = 290.0  # kg, weighed: no force is measured
SAMPLE_TIME = 5e-3  # s
LEVELS = (-0.03, 0.03)  # m
HOLD = 40


def force(x, p):
    """Of spring and damper on the body; travel: of the wheel towards it."""
    _wheel, spring, _tyre, compression, rebound = p
    travel, rate = x[2] - x[0], x[3] - x[1]
    return spring * travel + (compression if rate > 0.0 else rebound) * rate


def derivative(x, u, p):
    wheel, _spring, tyre, _compression, _rebound = p
    on_body = force(x, p)
    return (x[1], on_body / BODY, x[3], (tyre * (u[0] - x[2]) - on_body) / wheel)


model = ProcessModel(
    name="quarter_car",
    description="quarter of a car on a test bench",
    states=(State("z", "m"), State("v", "m/s"), State("z_wheel", "m"), State("v_wheel", "m/s")),
    inputs=(Input("road", "m", "zoh"),),
    outputs=(Output("travel", "m"), Output("acceleration", "m/s^2")),
    parameters=(
        Parameter("wheel", "kg", 50.0, 5.0, 500.0, "log"),
        Parameter("spring", "N/m", 2e4, 2e3, 2e5, "log"),
        Parameter("tyre", "N/m", 2e5, 2e4, 2e6, "log"),
        Parameter("compression", "N*s/m", 1e3, 100.0, 1e4, "log"),
        Parameter("rebound", "N*s/m", 1e3, 100.0, 1e4, "log"),
    ),
    derivative=derivative,
    output=lambda x, u, p: (x[2] - x[0], force(x, p) / BODY),
)
