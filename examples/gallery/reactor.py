"""A stirred tank in which a reaction makes heat, cooled through its wall.

Temperature makes the reaction faster (Arrhenius, about a reference of 350 K), which a slope at one
point does not tell (Bequette, "Process Dynamics", 1998). Its temperature is measured.
"""

import math

from sysid import Input, Output, Parameter, ProcessModel, State

TRUTH = {"rate": 0.04, "activation": 8750.0, "heat": 110.0, "wall": 0.035}
FLOW, FEED, INLET, REFERENCE = 0.017, 1.0, 350.0, 350.0  # 1/s, mol/l, K, K
SAMPLE_TIME = 2.0  # s
LEVELS = (270.0, 320.0)  # K, of the coolant
HOLD = 50


def derivative(x, u, p):
    concentration, temperature = x
    rate, activation, heat, wall = p
    faster = math.exp(activation * (1.0 / REFERENCE - 1.0 / temperature))
    reacting = rate * faster * concentration
    cooling = wall * (temperature - u[0])
    return (
        FLOW * (FEED - concentration) - reacting,
        FLOW * (INLET - temperature) + heat * reacting - cooling,
    )


model = ProcessModel(
    name="reactor",
    description="stirred tank with an exothermic reaction",
    states=(State("concentration", "mol/l", initial=0.5), State("temperature", "K", initial=350.0)),
    inputs=(Input("coolant", "K", "zoh"),),
    outputs=(Output("temperature", "K"),),
    parameters=(
        Parameter("rate", "1/s", 0.02, 2e-3, 0.2, "log", description="at the reference"),
        Parameter("activation", "K", 8e3, 2e3, 2e4, description="energy by the gas constant"),
        Parameter("heat", "K*l/mol", 150.0, 20.0, 1e3, "log", description="by the capacity"),
        Parameter("wall", "1/s", 0.03, 3e-3, 0.3, "log", description="by the capacity"),
    ),
    derivative=derivative,
)
