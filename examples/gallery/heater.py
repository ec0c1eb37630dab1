"""A heater with its sensor, which loses heat to the air and by radiation.

C dT/dt = P - h (T - T_a) - r (T^4 - T_a^4), read by a sensor that lags behind.
"""

from sysid import Input, Output, Parameter, ProcessModel, State
from sysid.problem.shapes import radiation

TRUTH = {"capacity": 12.0, "loss": 0.045, "radiating": 2.2e-10, "lag": 18.0}
SAMPLE_TIME = 5.0  # s
LEVELS = (0.0, 12.0)  # W
HOLD = 60
AMBIENT = 21.0  # degrees Celsius


def derivative(x, u, p):
    plate, sensor = x
    capacity, loss, radiating, lag = p
    lost = loss * (plate - AMBIENT) + radiating * radiation(plate, AMBIENT)
    return ((u[0] - lost) / capacity, (plate - sensor) / lag)


model = ProcessModel(
    name="heater",
    description="heater that radiates, and its sensor",
    states=(State("plate", "degC", initial=AMBIENT), State("sensor", "degC", initial=AMBIENT)),
    inputs=(Input("power", "W", "zoh"),),
    outputs=(Output("sensor", "degC"),),
    parameters=(
        Parameter("capacity", "J/K", 10.0, 1.0, 100.0, "log"),
        Parameter("loss", "W/K", 0.05, 5e-3, 0.5, "log"),
        Parameter("radiating", "W/K^4", 1e-10, 1e-11, 1e-9, "log"),
        Parameter("lag", "s", 10.0, 1.0, 100.0, "log"),
    ),
    derivative=derivative,
)
