"""The verdict on an identification, as a prompt and a notebook show it."""

from dataclasses import dataclass

from daq.views import Lines, Shown
from sysid.judging.assessment import Verdict


@dataclass(frozen=True, repr=False)
class ShownVerdict(Shown, Verdict):
    """A verdict in a line, with a row for each reason and note below."""

    @property
    def headline(self) -> str:
        """What may be used, and how far."""
        return f"predictions {self.predicted.trust}, parameters {self.parameters.trust}"

    def lines(self) -> Lines:
        """Statement, its trust, and a reason."""
        statements = {"predictions": self.predicted, "parameters": self.parameters}
        rows = [["of", "trust", "reason"]]
        rows += [[name, s.trust, reason] for name, s in statements.items() for reason in s.reasons]
        return [*rows, *(["note", "", note] for note in self.notes)]
