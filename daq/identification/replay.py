"""Replay: a log's inputs through a model with given parameters."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.config import check, yaml_file
from daq.config.identification import Signals
from daq.config.yaml_file import YamlFile
from daq.errors import ConfigError, suggestion
from daq.hal import FloatArray, Simulation
from daq.identification.fit import take
from daq.identification.request import SettingsRequest, result_file
from daq.identification.result import Identification
from daq.identification.settings import Problem, problem_of, reading_of, with_signals
from daq.lookup.models import find_model, title_of
from daq.lookup.rigs import DEFAULT_RIG, load_rig
from daq.notation import percent, quantity
from daq.views import Lines, Shown
from sysid import BatchSimulator, Metrics, ModelError, ProcessModel, evaluate, free_run
from sysid.problem.ranges import ties

if TYPE_CHECKING:
    import pandas as pd

    from daq.identification.fit import Source


@dataclass(frozen=True, repr=False)
class Replay(Shown):
    """A log's inputs through a model, beside what was measured.

    model_title: what to call the model. time: (n,) [s]. measured, simulated: (n, n_outputs) in the
    outputs' units. source: where the parameters come from. warning: how the logged run ended if it
    did not complete. config: what gave a model by name values that are not its own. by_name:
    whether the source is a model's name.

    >>> from daq import record, replay
    >>> result = replay(record("prbs.yaml"))
    >>> result.below({"omega": 100.1})
    {'omega': 100.1}
    """

    path: Path
    model: ProcessModel
    model_title: str
    source: str
    time: FloatArray
    measured: FloatArray
    simulated: FloatArray
    metrics: Metrics
    warning: str | None
    config: Path | None = None
    by_name: bool = False

    @property
    def title(self) -> str:
        """The model, and where its parameters come from."""
        if self.by_name:
            values = "at its own values" if self.config is None else f"with values of {self.config}"
            return f"{self.model_title} {values}"
        return f"{self.model_title} with the parameters of {self.source}"

    @property
    def headline(self) -> str:
        """The log, the model, and where its parameters come from."""
        return f"{self.path} through {self.title}"

    def lines(self) -> Lines:
        """Fit and errors of each output."""
        errors, units = self.rmse_absolute, {o.name: o.unit for o in self.model.outputs}
        rows = [["output", "fit [%]", "RMSE"]]
        rows += [[k, percent(fit), quantity(errors[k], units[k])] for k, fit in self.fit.items()]
        return rows

    @property
    def fit(self) -> dict[str, float]:
        """Fit of each output [%]: 100 is perfect, 0 no better than its mean."""
        return self._by_output(self.metrics.fit)

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean squared error of each output in parts of its largest measured value."""
        return self._by_output(self.metrics.rmse)

    @property
    def msd(self) -> dict[str, float]:
        """Mean signed deviation of each output in parts of its largest measured value."""
        return self._by_output(self.metrics.msd)

    @property
    def rmse_absolute(self) -> dict[str, float]:
        """Root mean squared error of each output in its unit."""
        return self._by_output(self.metrics.rmse_absolute)

    @property
    def frame(self) -> pd.DataFrame:
        """A table: ``t`` [s], each output as measured, and as ``<output>_simulated``."""
        import pandas as pd

        names = self.model.output_names
        signals = (*names, *(f"{name}_simulated" for name in names))
        values = (*self.measured.T, *self.simulated.T)
        return pd.DataFrame({"t": self.time, **dict(zip(signals, values, strict=True))})

    def below(self, bounds: Mapping[str, float]) -> dict[str, float]:
        """Those of the required fits [%], by output, that this replay does not reach.

        A simulation that failed has NaN for a fit, which reaches none.
        """
        return {name: bound for name, bound in bounds.items() if not self.fit[name] >= bound}

    def _by_output(self, values: FloatArray) -> dict[str, float]:
        return dict(zip(self.model.output_names, values.tolist(), strict=True))


def replay(
    log: Source,
    parameters: Identification | str | Path | None = None,
    rig: str | Path = DEFAULT_RIG,
    config: str | Path | None = None,
    *,
    model: str | None = None,
    settings: Sequence[str] = (),
    trust: bool = False,
) -> Replay:
    """Simulate a model under the applied commands and the measured load of a log.

    log: as for ``identify``. parameters: an identification, its ``parameters.yaml``, its folder or
    its run's. model: in place of parameters a model by name, at its own values, such as
    ``actuator:parameters=A``. config: settings of ``identify``, of which the columns of a foreign
    log and the part of it that is used count, and without parameters its model, fixed and tied
    values, outputs and starts. settings: others over those, as ``key=value``. Without any of these
    the parameters are those of the simulated ``rig``. trust: run the Python file of a model that
    ``parameters.yaml`` names. Raises ConfigError.

    >>> from daq import record, replay
    >>> result = replay(record("prbs.yaml"))  # through the simulated rig's own model
    >>> result.fit["current_motor"] > 95.0
    True
    """
    file, valued = None if config is None else Path(config), None
    by_name = parameters is None and (
        model is not None or (file is not None and _sets_values(file))
    )
    if by_name:
        request = SettingsRequest(None if file is None else str(file), {"model": model}, settings)
        problem = problem_of(request)
        chosen, values, source = problem.model, _declared(problem), problem.model_name
        title = title_of(source, chosen)
        under = problem.settings
        valued = file if under.fixed or under.tied or problem.given else None
        mapping, selection = problem.mapping, problem.selection
    elif model is not None:
        raise ConfigError(
            "a result names its own model", cure="give --parameters or --model", key="--model"
        )
    else:
        chosen, title, values, source = _parameters(parameters, str(rig), trust)
        mapping, selection = reading_of(file, settings, chosen)
    logged = take(log, "data", chosen, mapping, selection)
    record = logged.dataset
    try:
        simulated = free_run(BatchSimulator(chosen), chosen.vector(values), record)
    except ModelError as error:
        raise ConfigError(str(error)) from None
    time = np.arange(record.n_samples, dtype=np.float64) * record.dt
    metrics, measured = evaluate(record.outputs, simulated), record.outputs
    return Replay(
        logged.path,
        chosen,
        title,
        source,
        time,
        measured,
        simulated,
        metrics,
        logged.warning,
        valued,
        by_name,
    )


def _sets_values(config: Path) -> bool:
    """Whether a configuration says which model it is, or gives it values."""
    content = yaml_file.load(config).content
    return any(content.get(key) is not None for key in ("model", "fixed", "tied", "given"))


def short_names(replays: Sequence[Replay]) -> list[str]:
    """Where each has its parameters from, without what all have in common up to an option.

    >>> from types import SimpleNamespace as Named
    >>> short_names([Named(source="actuator:parameters=A"), Named(source="actuator:parameters=B")])
    ['A', 'B']
    """
    alike = os.path.commonprefix([replay.source for replay in replays])  # noqa: RUF071
    common = re.split(r"[^:,=]*$", alike)[0]
    return [replay.source.removeprefix(common) or replay.source for replay in replays]


def _declared(problem: Problem) -> dict[str, float]:
    """A model's own values, but for those that the settings fix, are given or tie."""
    model, settings = problem.model, problem.settings
    vector = model.vector(problem.fixed)
    for tie in ties(model, settings.tied):
        vector[tie.index] = tie.factor * vector[tie.source]
    return dict(zip(model.parameter_names, vector.tolist(), strict=True))


def _parameters(
    parameters: Identification | str | Path | None, rig: str, trust: bool
) -> tuple[ProcessModel, str, dict[str, float], str]:
    """A model and what to call it, its parameters, and where they come from."""
    if isinstance(parameters, Identification):
        values = dict(parameters.estimator.parameters_)
        return parameters.model, parameters.title, values, "identification"
    if parameters is not None:
        file = yaml_file.load(result_file(parameters))
        model, values = _read(file, trust)
        return model, title_of(file.content["model"], model), values, str(parameters)
    _, device = load_rig(rig)
    if not isinstance(device, Simulation):
        cure = "give those of an identification with --parameters"
        raise ConfigError("only a simulated rig knows its own parameters", cure=cure, file=rig)
    try:
        model = device.process_model()
    except ModelError as error:
        raise ConfigError(str(error), file=rig) from None
    values = dict(zip(model.parameter_names, model.nominal, strict=True))
    return model, model.name, values, rig


def read_parameters(path: Path, trust: bool) -> tuple[ProcessModel, dict[str, float]]:
    """Model and parameters from a parameters.yaml, as identification writes it.

    trust: run the Python file of the model, where it is in one. Raises ConfigError naming line and
    key of what is missing or wrong.
    """
    return _read(yaml_file.load(path), trust)


def _read(file: YamlFile, trust: bool) -> tuple[ProcessModel, dict[str, float]]:
    path, name = file.path, file.content.get("model")
    if not isinstance(name, str):
        raise file.error(("model",), "this key is missing; it names the process model")
    try:
        model = find_model(name, path.parent, record=None if trust else path)
    except ConfigError as error:
        if error.file == path:
            raise
        raise file.error(("model",), str(error)) from None
    signals = {key: file.content[key] for key in Signals.model_fields if key in file.content}
    model = with_signals(file, check.validate(file, Signals, signals), model)
    entries = file.content.get("parameters")
    if not isinstance(entries, dict):
        raise file.error(("parameters",), "this key is missing; it holds 'name: value' lines")
    values = {}
    for name, entry in entries.items():
        key = ("parameters", str(name))
        if name not in model.parameter_names:
            hint = suggestion(str(name), model.parameter_names)
            raise file.error(key, f"model {model.name} has no such parameter; {hint}")
        value = entry.get("value") if isinstance(entry, dict) else entry
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise file.error(key, f"expected a number, found {value!r}")
        if not math.isfinite(value):
            raise file.error(key, f"expected a finite number, found {value}")
        values[name] = float(value)
    return model, values
