"""What a model's equations tell of its parameters, before any log is recorded."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from daq.errors import ConfigError
from daq.identification.request import SettingsRequest
from daq.identification.settings import problem_of
from daq.lookup.models import title_of
from sysid import Identifiability, ModelError, ProcessModel, TiedGroup, identifiability


@dataclass(frozen=True)
class Structure:
    """A model as it would be identified, and what its outputs determine of it.

    title: what to call the model. ties: expressions of the parameters that the settings tie to
    others.
    """

    title: str
    model: ProcessModel
    identifiability: Identifiability
    ties: Mapping[str, str]

    @property
    def fixed(self) -> dict[str, float]:
        """Values of the parameters that are neither free nor tied to others by the settings."""
        held = (p for p in self.model.parameters if p.fixed)
        return {p.name: p.nominal for p in held if p.name not in self.ties}

    @property
    def document(self) -> dict[str, Any]:
        """All of it, as JSON can hold it."""
        result = self.identifiability
        return {
            "model": self.title,
            "outputs": list(result.outputs),
            "unknown_starts": list(result.unknown_starts),
            "fixed": self.fixed,
            "ties": dict(self.ties),
            "identifiable": list(result.identifiable),
            "tied": [_group(group) for group in result.tied],
            "unseen": list(result.unseen),
            "gap_decades": result.gap,
            "assumptions": list(self.model.assumptions),
        }


def examine(request: SettingsRequest) -> Structure:
    """Identifiability of the model that a request names, with its outputs, starts and ties.

    Raises ConfigError for mistakes in the settings, and for equations that cannot be followed.
    """
    problem = problem_of(request)
    chosen = problem.settings
    model = problem.space.as_model()
    try:
        result = identifiability(model, seed=chosen.seed)
    except ModelError as error:
        raise ConfigError(str(error)) from None
    return Structure(title_of(problem.model_name, problem.model), model, result, chosen.tied)


def _group(group: TiedGroup) -> dict[str, Any]:
    return {
        "parameters": list(group.parameters),
        "determined": group.count,
        "combinations": [{"text": c.text, "unit": c.unit} for c in group.combinations],
        "directions": group.directions.tolist(),
        "at": dict(group.values),
        "fix": list(group.fix),
        "sensors": {state: list(names) for state, names in group.sensors.items()},
    }
