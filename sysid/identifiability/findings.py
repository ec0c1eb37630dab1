"""What an analysis of identifiability says."""

from collections.abc import Mapping
from dataclasses import dataclass

from sysid.arrays import FloatArray
from sysid.identifiability.combination import Combination


@dataclass(frozen=True)
class TiedGroup:
    """Parameters, and starts such as ``z(0)``, that the outputs show only together.

    count: how many independent combinations of them the outputs determine. combinations: those
    with a simple form, at most count. directions: (k, n_members), how the members move at
    ``values`` without any output showing it. fix: members whose values, measured by other means,
    determine all the others, what is easiest to measure first. sensors: by state, the members
    that measuring it as well would determine; states that would determine none are left out.

    >>> from sysid import Output, Parameter, ProcessModel, State, identifiability
    >>> decay = ProcessModel(
    ...     "decay", [State("x", "m", initial_range=(0.5, 2.0))], [], [Output("reading", "V")],
    ...     [Parameter("k", "1/s", 1.0, 0.1, 10.0), Parameter("gain", "V/m", 1.0, 0.1, 10.0)],
    ...     lambda x, u, p: (-p[0] * x[0],), lambda x, u, p: (p[1] * x[0],),
    ... )
    >>> (group,) = identifiability(decay).tied
    >>> group.parameters, group.combinations[0].text, dict(group.sensors)
    (('gain', 'x(0)'), 'gain x(0)', {'x': ('gain', 'x(0)')})
    """

    parameters: tuple[str, ...]
    count: int
    combinations: tuple[Combination, ...]
    directions: FloatArray
    values: Mapping[str, float]
    fix: tuple[str, ...]
    sensors: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Identifiability:
    """What outputs of a model determine, if inputs and records are rich enough.

    outputs, unknown_starts: for which this holds. identifiable: parameters and starts that have
    a value of their own. tied: the others, by groups. unseen: those that act on no output.
    gap: decades between what was counted as a change of the outputs and what as none.

    >>> from sysid import identifiability
    >>> from sysid.examples import lag
    >>> result = identifiability(lag())
    >>> result.outputs, result.identifiable, result.tied
    (('y',), ('gain', 'tau'), ())
    """

    outputs: tuple[str, ...]
    unknown_starts: tuple[str, ...]
    identifiable: tuple[str, ...]
    tied: tuple[TiedGroup, ...]
    unseen: tuple[str, ...]
    gap: float
