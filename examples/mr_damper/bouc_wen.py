"""The textbook model of a magnetorheological damper: a current-dependent Bouc-Wen element.

    force = alpha(i) z + c(i) v + k x + f0
    dz/dt = (v - sigma |v| z |z| - (1 - sigma) v z^2) / delta

z runs from -1 to 1 and saturates there after a motion of a few delta; sigma above one half keeps
the loop dissipative. alpha and c grow linearly with the current, k is the elastic term (gas
accumulator), f0 an offset.
"""

from sysid import Input, Output, Parameter, ProcessModel, State


def derivative(x, u, p):
    _displacement, z = x
    v, _i = u
    delta, sigma = p[6], p[7]
    return (v, (v - sigma * abs(v) * z * abs(z) - (1.0 - sigma) * v * z * z) / delta)


def output(x, u, p):
    displacement, z = x
    v, i = u
    alpha0, alpha1, c0, c1, k, f0 = p[:6]
    return ((alpha0 + alpha1 * i) * z + (c0 + c1 * i) * v + k * displacement + f0,)


def between(lower, upper):
    return {"nominal": (lower * upper) ** 0.5, "lower": lower, "upper": upper, "scale": "log"}


model = ProcessModel(
    name="mr_damper_bouc_wen",
    description="magnetorheological damper, current-dependent Bouc-Wen",
    states=(State("displacement", "m"), State("z", "1")),
    inputs=(Input("velocity", "m/s", "foh"), Input("current", "A")),
    outputs=(Output("force", "N"),),
    parameters=(
        Parameter("alpha0", "N", **between(20.0, 1000.0)),
        Parameter("alpha1", "N/A", **between(100.0, 6000.0)),
        Parameter("c0", "N*s/m", **between(50.0, 20000.0)),
        Parameter("c1", "N*s/(m*A)", **between(50.0, 20000.0)),
        Parameter("k", "N/m", **between(10.0, 20000.0)),
        Parameter("f0", "N", 0.0, -200.0, 200.0, minimum=float("-inf")),
        Parameter("delta", "m", **between(5e-5, 5e-3)),
        Parameter("sigma", "1", 0.75, 0.5, 1.0, maximum=1.0),
    ),
    derivative=derivative,
    output=output,
)
