"""What a model's equations alone can tell of its parameters, without any data.

A parameter is structurally identifiable where no other value of it, whatever the rest does, gives
the same outputs in every record. Inputs are any functions of time, starts are as the model
declares, the point is one like any other in the parameters' ranges: what holds there holds
everywhere but in exceptions without extent (Walter & Pronzato, "Identification of Parametric
Models", 1997; Sedoglavic, "A probabilistic algorithm to test local algebraic observability in
polynomial time", 2002). It is a local property: several isolated values may be left.
"""

from sysid.identifiability.findings import Identifiability
from sysid.problem.model import ProcessModel


def identifiability(model: ProcessModel, *, seed: int = 0, sensors: bool = True) -> Identifiability:
    """Which parameters of a model its outputs determine, which only together, and how.

    Parameters that are not ``fixed`` are free. Starts that the model estimates are unknown, those
    of measured outputs known, and the rest where the model declares. Use ``with_outputs``,
    ``with_initial`` and ``with_parameters`` to ask about other choices. sensors: whether it is
    tried what measuring further states would determine, which takes most of the time. Raises
    ModelError where the equations cannot be followed.

    >>> from sysid import Input, Output, Parameter, ProcessModel, State
    >>> shaft = ProcessModel(
    ...     "shaft", [State("omega", "rad/s")], [Input("torque", "N*m")],
    ...     [Output("omega", "rad/s")],
    ...     [Parameter(name, "kg*m^2", 1e-4, 1e-5, 1e-3, "log") for name in ("J_m", "J_b")],
    ...     lambda x, u, p: (u[0] / (p[0] + p[1]),),
    ... )
    >>> (group,) = identifiability(shaft).tied
    >>> group.parameters, [c.text for c in group.combinations], group.fix
    (('J_m', 'J_b'), ['J_m + J_b'], ('J_m',))
    """
    from sysid.identifiability.tied_groups import Analysis  # loads flint

    return Analysis(model, seed).result(sensors)
