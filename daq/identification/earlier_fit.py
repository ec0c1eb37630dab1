"""Where an identification begins that has the logs of an earlier one and more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sysid import EarlierMinima
from sysid.judging.assessment import coloured_innovations

if TYPE_CHECKING:
    from daq.identification.result import Identification

_FARTHEST = 2.0  # half widths of its interval, by which more logs may move a quantity
# Variance of estimates from single logs in parts of what noise makes: beside right minima up to 1.8
# was seen, beside a wrong one 5.7.
_AT_ODDS = 3.0
_NOISIER = 2.0  # times the noise that an output had


@dataclass(frozen=True)
class EarlierFit:
    """Where an identification from some of the logs has ended.

    minima: where. intervals: the 95 % intervals of all that logs can tell.
    """

    minima: EarlierMinima
    intervals: Mapping[str, tuple[float, float]]

    def is_near(self, values: Mapping[str, float]) -> bool:
        """Whether no value of a quantity by its name lies far beyond the interval that it had."""
        return all(
            abs(values[name] - 0.5 * (low + high)) <= _FARTHEST * 0.5 * (high - low)
            for name, (low, high) in self.intervals.items()
            if name in values
        )

    def explains(
        self, values: Mapping[str, float], noise: Mapping[str, float], least: Mapping[str, float]
    ) -> bool:
        """Whether a fit of all logs is near, and needs no more noise than that of some of them did.

        noise: of outputs by name, by which a filter judged all logs; least: what it is at least,
        whatever a fit explains, which depends on the logs.
        """
        before = self.minima.noise
        noisier = (
            now > _NOISIER * max(before.get(name, now), least.get(name, 0.0))
            for name, now in noise.items()
        )
        return self.is_near(values) and not any(noisier)

    def agrees(self, result: Identification) -> bool:
        """Whether the minimum beside it explains all logs alike, and stays near its intervals.

        What the earlier logs rule out more logs rule out as well, unless these say that the
        earlier minimum was not the right one.
        """
        uncertainty = result.uncertainty
        if uncertainty is None or uncertainty.disagreement > _AT_ODDS:
            return False
        if coloured_innovations(uncertainty).any():
            return False
        values = {estimate.name: estimate.value for estimate in uncertainty.determined()}
        return self.intervals.keys() <= values.keys() and self.is_near(values)
