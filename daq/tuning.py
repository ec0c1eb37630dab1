"""From an identification to a torque controller: what ``rig tune`` does."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.config import yaml_file
from daq.errors import ConfigError
from daq.files import write_whole
from daq.hal import FloatArray
from daq.identification import stages
from daq.identification.replay import read_parameters
from daq.lookup.controllers import load_settings
from daq.lookup.models import find_model, name_parts
from daq.progress import Watch, ignore
from daq.provenance import software_versions
from daq.torque import Fact, OperatingPoint, TorqueControl
from daq.views import Lines, Shown
from sysid import ModelError, ProcessModel
from sysid.threads import one_thread
from sysid.uncertainty.draws import plausible_parameters

_HEAD = """\
# A torque controller, made by rig tune; experiments name this file under 'torque_controller'.
"""


@dataclass(frozen=True, repr=False)
class Tuning(Shown):
    """A controller for an actuator, and what it rests on.

    requested: its settings as they were given; ``control`` has them as the uncertainty allows.
    parameters: values by name. source: where they come from. facts: quantities of the actuator,
    with the spread that the identification's uncertainty gives them. draws: plausible parameters,
    (n, n_parameters). uncertain: parameters that the identification gives no interval, which are
    taken as they are. covariance: of the parameters, as the result's file has it; or empty.

    >>> from daq import tune
    >>> tuning = tune("torque.yaml", model="actuator:parameters=rig")
    >>> {fact.name: round(fact.value, 4) for fact in tuning.facts}["motor_constant"]
    0.1412
    """

    requested: TorqueControl
    control: TorqueControl
    model_name: str
    model: ProcessModel
    parameters: Mapping[str, float]
    source: str
    facts: tuple[Fact, ...]
    draws: FloatArray
    uncertain: tuple[str, ...]
    covariance: Mapping[str, Any]

    @property
    def headline(self) -> str:
        """The controller, and where the parameters come from."""
        return f"{type(self.control).__name__.lower()} for {self.model_name}, {self.source}"

    def lines(self) -> Lines:
        """Quantities of the actuator, with what the identification leaves open."""
        rows = [["quantity", "value", "95 % interval", "unit"]]
        for fact in self.facts:
            span = " .. ".join(f"{end:.4g}" for end in fact.interval) if fact.interval else "-"
            rows.append([fact.name, f"{fact.value:.4g}", span, fact.unit])
        return rows

    @property
    def changes(self) -> dict[str, tuple[Any, Any]]:
        """Settings that tuning has changed: as requested, and as they are."""
        before, after = self.requested.model_dump(mode="json"), self.control.model_dump(mode="json")
        return {key: (before[key], after[key]) for key in after if before[key] != after[key]}

    @cached_property
    def document(self) -> dict[str, Any]:
        """What the controller's file holds."""
        return {
            "settings": self.control.model_dump(mode="json"),
            "model": self.model_name,
            "parameters": dict(self.parameters),
            "source": self.source,
            "draws": len(self.draws),
            "facts": {
                fact.name: {
                    "value": float(f"{fact.value:.6g}"),
                    "unit": fact.unit,
                    **({"interval": list(fact.interval)} if fact.interval else {}),
                }
                for fact in self.facts
            },
            "operating_points": [
                {
                    "branch": point.branch,
                    "brake_current": round(point.brake_current, 6),
                    "stiffness": float(f"{point.stiffness:.4g}"),
                    "damping": float(f"{point.damping:.4g}"),
                }
                for point in self.operating_points()
            ],
            **({"without_interval": list(self.uncertain)} if self.uncertain else {}),
            **({"covariance": dict(self.covariance)} if self.covariance.get("parameters") else {}),
            "software": software_versions(),
        }

    def operating_points(self, draw: int | None = None) -> tuple[OperatingPoint, ...]:
        """The family of linear models, of the parameters or of one of the draws."""
        vector = self.model.vector(dict(self.parameters)) if draw is None else self.draws[draw]
        return self.control.operating_points(self.model, vector)

    def save(self, path: str | Path) -> None:
        """Write the file that experiments name. Raises ConfigError."""
        text = yaml.safe_dump(self.document, sort_keys=False, allow_unicode=True)
        write_whole(Path(path), _HEAD + text)


@one_thread()
def tune(
    settings: str | Path,
    parameters: str | Path | None = None,
    *,
    model: str | None = None,
    draws: int = 200,
    seed: int = 0,
    watch: Watch = ignore,
) -> Tuning:
    """Make a torque controller for identified parameters.

    settings: file as for ``rig tune``. parameters: what an identification wrote. model: in place
    of it a model by name, at its own values, such as ``actuator:parameters=A``. draws: plausible
    parameters, drawn from the identification's covariance, that tell how well the controller knows
    its actuator. Raises ConfigError.

    >>> from daq import tune
    >>> tune("torque.yaml", model="actuator:parameters=rig").control.controller
    'feedforward'
    """
    control = load_settings(str(settings), watch)
    if (parameters is None) == (model is None):
        raise ConfigError(
            "which actuator the controller is for is not said" if model is None else
            "a result names its own model",
            cure="give --parameters PARAMETERS.yaml, or --model NAME for a model's own values",
        )  # fmt: skip
    if parameters is None:
        assert model is not None
        chosen, name, source = find_model(model), model, model
        vector = chosen.nominal
        uncertain: tuple[str, ...] = ()
        covariance: dict[str, Any] = {}
        plausible = np.empty((0, len(vector)))
    else:
        path = Path(parameters)
        file = stages.load([path])[0]
        name, source = file.content.get("model", ""), str(file.path)
        chosen, values = read_parameters(file.path, trust=False)
        vector = chosen.vector(values)
        covariance, uncertain = _spread(file, chosen)
        columns = covariance["parameters"]
        rows = np.array(covariance["factor"]).reshape(len(covariance["factor"]), len(columns))
        plausible = plausible_parameters(chosen, vector, columns, rows, draws, seed)
    if name_parts(name)[1] is not None:
        raise ConfigError(
            f"model {name} lies in a file, which each experiment would run with the controller",
            cure="install it under the entry point rig.models, and name it so",
        )
    try:
        facts = control.facts(chosen, vector, plausible)
        tuned = control.tuned(chosen, vector, facts).tuned_over(chosen, vector, plausible)
    except ModelError as error:
        raise ConfigError(str(error), file=source) from None
    named = dict(zip(chosen.parameter_names, vector.tolist(), strict=True))
    return Tuning(
        control, tuned, name, chosen, named, source, facts, plausible, uncertain, covariance
    )


def _spread(
    file: yaml_file.YamlFile, model: ProcessModel
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The covariance by parameters' names and rows, and the parameters that have no spread."""
    names = model.parameter_names
    columns = [name for name in file.content["covariance"].get("parameters") or () if name in names]
    factor = stages.factor(file, columns, model)
    rows = np.array(factor).reshape(len(factor), len(columns))
    searched = [p.name for p in model.parameters if not _is_fixed(file, p.name)]
    spread = {name for name, column in zip(columns, rows.T, strict=True) if np.any(column)}
    uncertain = tuple(name for name in searched if name not in spread)
    return {"parameters": columns, "factor": rows.tolist()}, uncertain


def _is_fixed(file: yaml_file.YamlFile, name: str) -> bool:
    entry = file.content["parameters"].get(name)
    return not isinstance(entry, dict) or bool(entry.get("fixed")) or "tied" in entry
