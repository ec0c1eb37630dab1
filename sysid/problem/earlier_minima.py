"""Where a fit has ended that had some of the records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class EarlierMinima:
    """Minima of a fit of some of the records, at which a fit of all of them begins.

    values: parameters by name in each, the best first. noise: of outputs by name, by which a filter
    judged them, in their units; empty without a filter. is_settled: whether those records told the
    first from all others.

    >>> EarlierMinima([{"tau": 0.2}]).is_settled
    False
    """

    values: Sequence[Mapping[str, float]]
    noise: Mapping[str, float] = field(default_factory=dict)
    is_settled: bool = False
