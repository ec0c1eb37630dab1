"""Replay: a log's inputs through a model with given parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ConfigError
from daq.hal import FloatArray, Simulation
from daq.identification.fit import take
from daq.identification.parameters import read_parameters
from daq.identification.result import Identification
from daq.identification.settings import columns_of
from daq.lookup.rigs import DEFAULT_RIG, load_rig
from sysid import BatchSimulator, Metrics, ModelError, ProcessModel, evaluate, free_run

if TYPE_CHECKING:
    import pandas as pd

    from daq.identification.fit import Source


@dataclass(frozen=True)
class Replay:
    """A log's inputs through a model, beside what was measured.

    time: (n,) [s]. measured, simulated: (n, n_outputs) in the outputs' units. source: whose
    parameters. warning: how a run that did not complete ended.

    >>> from daq import record, replay
    >>> result = replay(record("prbs.yaml"))
    >>> result.below({"omega": 100.1})
    {'omega': 100.1}
    """

    path: Path
    model: ProcessModel
    source: str
    time: FloatArray
    measured: FloatArray
    simulated: FloatArray
    metrics: Metrics
    warning: str | None

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
    def frame(self) -> pd.DataFrame:
        """A table: ``t`` [s], each output as measured, and as ``<output>_simulated``."""
        import pandas as pd

        names = self.model.output_names
        columns = {"t": self.time, **dict(zip(names, self.measured.T, strict=True))}
        for name, values in zip(names, self.simulated.T, strict=True):
            columns[f"{name}_simulated"] = values
        return pd.DataFrame(columns)

    def below(self, bounds: Mapping[str, float]) -> dict[str, float]:
        """Of least fits [%] by output, those that are missed.

        A fit that is not a number, of a simulation that failed, misses any.
        """
        return {name: least for name, least in bounds.items() if not self.fit[name] >= least}

    def _by_output(self, values: FloatArray) -> dict[str, float]:
        return dict(zip(self.model.output_names, values.tolist(), strict=True))


def replay(
    log: Source,
    parameters: Identification | str | Path | None = None,
    rig: str | Path = DEFAULT_RIG,
    config: str | Path | None = None,
) -> Replay:
    """Simulate what a log's applied commands and measured load do to a model.

    log: as for ``identify``. parameters: an identification or its ``parameters.yaml``; default
    those of the simulated rig. config: names the columns of a foreign log. Raises ConfigError.

    >>> from daq import record, replay
    >>> result = replay(record("prbs.yaml"))  # through the simulated rig's own model
    >>> result.fit["current_motor"] > 95.0
    True
    """
    model, values, source = _parameters(parameters, str(rig))
    mapping = columns_of(Path(config) if config is not None else None, model)
    logged = take(log, "data", model, mapping)
    record = logged.dataset
    try:
        simulated = free_run(BatchSimulator(model), model.vector(values), record)
    except ModelError as error:
        raise ConfigError(str(error)) from None
    return Replay(
        logged.path,
        model,
        source,
        np.arange(record.n_samples, dtype=np.float64) * record.dt,
        record.outputs,
        simulated,
        evaluate(record.outputs, simulated),
        logged.warning,
    )


def _parameters(
    parameters: Identification | str | Path | None, rig: str
) -> tuple[ProcessModel, dict[str, float], str]:
    """Model and values, and whose they are."""
    if parameters is None:
        return *_parameters_of_rig(rig), rig
    if isinstance(parameters, Identification):
        return parameters.model, dict(parameters.estimator.parameters_), "identification"
    return *read_parameters(Path(parameters)), str(parameters)


def _parameters_of_rig(rig: str) -> tuple[ProcessModel, dict[str, float]]:
    _, device = load_rig(rig)
    if not isinstance(device, Simulation):
        raise ConfigError(
            "only a simulated rig knows its own parameters",
            cure="give those of an identification with --parameters",
            file=rig,
        )
    try:
        model = device.process_model()
    except ModelError as error:
        raise ConfigError(str(error), file=rig) from None
    return model, dict(zip(model.parameter_names, model.nominal, strict=True))
