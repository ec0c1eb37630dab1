"""A finished identification: what it was made of, and one document of it for machines."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.identification import IdentificationConfig, Signals
from daq.identification.records import Loaded
from daq.provenance import software_versions
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.judging.assessment import RecordResult, Verdict, judge
from sysid.problem.metrics import Metrics
from sysid.problem.model import Parameter, ProcessModel
from sysid.uncertainty import Estimate, Profile, Uncertainty

# What is said of a parameter without an interval, by why it has none.
NOTES = {
    "tied": "only with others",
    "vague": "hardly felt",
    "bound": "at its end",
    "rival": "two answers",
    "": "",
}


@dataclass(frozen=True)
class Identified:
    """A finished identification and what it was made of.

    sources: where each parameter's range or value stands that is not the model's own.
    uncertainty: None where the search was not refined to a minimum. training, validation: one
    result for each log, in their order. training_runs, validation_runs: the free run on each,
    (n_samples, n_outputs).
    """

    model: ProcessModel
    model_name: str
    settings: IdentificationConfig
    sources: Mapping[str, str]
    columns_file: Path | None
    estimator: GASSI
    uncertainty: Uncertainty | None
    profiles: Sequence[Profile]
    training: Sequence[RecordResult]
    validation: Sequence[RecordResult]
    training_logs: Sequence[Loaded]
    validation_logs: Sequence[Loaded]
    training_runs: Sequence[FloatArray]
    validation_runs: Sequence[FloatArray]

    @cached_property
    def verdict(self) -> Verdict:
        """How far to trust it, and why."""
        return judge(
            self.model,
            self.training,
            self.validation,
            self.uncertainty,
            self.estimator.feasible_,
        )

    def source(self, name: str) -> str:
        """Where a parameter's range or value comes from."""
        return self.sources.get(name, "model")

    def estimate(self, name: str) -> Estimate | None:
        """What is known of a free parameter's uncertainty."""
        found = self.uncertainty.parameters if self.uncertainty is not None else ()
        return next((e for e in found if e.name == name), None)

    def on_bound(self, name: str) -> bool:
        """Whether a free parameter is held by an end of its range."""
        if (estimate := self.estimate(name)) is not None:
            return estimate.why == "bound"
        space = self.estimator.space_
        return bool(space.on_bound(self.estimator.chromosome_)[space.names.index(name)])


def document(result: Identified) -> dict[str, Any]:
    """All of it for machines; what ``parameters.yaml`` holds."""
    estimator, settings = result.estimator, result.settings
    verdict = result.verdict
    parts = (
        ("training", result.training, result.training_logs),
        ("validation", result.validation, result.validation_logs),
    )
    return {
        "model": result.model_name,
        **_signals(settings),
        "verdict": {"trust": verdict.trust, "reasons": list(verdict.reasons)},
        "parameters": {p.name: _parameter(result, p) for p in result.model.parameters},
        **_initial_states(result),
        **_uncertainty(result.uncertainty),
        **_profiles(result.profiles),
        "error": {
            "value": estimator.error_,
            "meaning": "mean over outputs of the RMSE on outputs normalised by max|y|",
            "before_refinement": estimator.search_error_,
        },
        "metrics": {
            part: [
                {"log": str(log.path), "name": record.name, **_record(result.model, record)}
                for record, log in zip(records, logs, strict=True)
            ]
            for part, records, logs in parts
        },
        "search": {
            "preset": settings.preset,
            "seed": settings.seed,
            "population": settings.population,
            "generations": len(estimator.history_),
            "simulations": estimator.n_simulations_,
            "stopped": estimator.stopped_,
            "flagged": estimator.flagged_,
            "feasible": estimator.feasible_,
        },
        "software": software_versions(),
    }


def _signals(signals: Signals) -> dict[str, Any]:
    """How the model was used where not as it declares; ``rig replay`` uses it likewise."""
    chosen = {
        "outputs": list(signals.outputs),
        "initial": {
            name: list(start) if isinstance(start, tuple) else start
            for name, start in signals.initial.items()
        },
        "hold": dict(signals.hold),
    }
    return {key: value for key, value in chosen.items() if value}


def _parameter(result: Identified, parameter: Parameter) -> dict[str, Any]:
    name = parameter.name
    entry: dict[str, Any] = {"value": result.estimator.parameters_[name], "unit": parameter.unit}
    space = result.estimator.space_
    if name in space.names:
        searched = space.parameters[space.names.index(name)]
        entry["range"] = [searched.lower, searched.upper]
        entry["scale"] = searched.scale
        entry["on_bound"] = result.on_bound(name)
        if (estimate := result.estimate(name)) is not None:
            entry |= _interval(estimate)
    elif name in result.settings.tied:
        entry["tied"] = result.settings.tied[name]
    else:
        entry["fixed"] = True
    entry["source"] = result.source(name)
    return entry


def _interval(estimate: Estimate) -> dict[str, Any]:
    if estimate.why:
        return {"undetermined": estimate.why}
    assert estimate.std is not None and estimate.low is not None and estimate.high is not None
    return {"std": float(estimate.std), "interval": [float(estimate.low), float(estimate.high)]}


def _initial_states(result: Identified) -> dict[str, Any]:
    """Initial states that were estimated, log by log."""
    found = result.estimator.initial_states_
    return {"initial_states": found} if any(found) else {}


def _uncertainty(found: Uncertainty | None) -> dict[str, Any]:
    if found is None:
        return {}
    names = [parameter.name for parameter in found.parameters]
    correlation = found.correlation()
    pairs = [
        {"parameters": [names[i], names[j]], "correlation": round(float(correlation[i, j]), 4)}
        for i, j in itertools.combinations(range(len(names)), 2)
        if np.isfinite(correlation[i, j])
        and not (found.parameters[i].why or found.parameters[j].why)
    ]
    return {
        "determined_directions": found.rank,
        "singular_values": [float(f"{value:.4g}") for value in found.singular_values],
        "ambiguities": [
            {
                "kind": ambiguity.kind,
                "parameters": list(ambiguity.parameters),
                "determined": [
                    {"name": e.name, "unit": e.unit, "value": e.value, **_interval(e)}
                    for e in ambiguity.determined
                ],
                "measure": list(ambiguity.measure),
            }
            for ambiguity in found.ambiguities
        ],
        **({"rivals": [dict(rival) for rival in found.rivals]} if found.rivals else {}),
        "correlations": pairs,
    }


def _profiles(found: Sequence[Profile]) -> dict[str, Any]:
    if not found:
        return {}
    return {
        "profiles": {
            one.name: {
                "interval": [one.low, one.high],
                "values": one.values.tolist(),
                "statistic": one.statistic.tolist(),
            }
            for one in found
        }
    }


def errors_of(model: ProcessModel, metrics: Metrics) -> dict[str, dict[str, float]]:
    """Errors of each output on one log."""
    return {
        name: {
            "rmse": float(metrics.rmse[j]),
            "msd": float(metrics.msd[j]),
            "fit_percent": float(metrics.fit[j]),
            "max_abs": float(metrics.scale[j]),
        }
        for j, name in enumerate(model.output_names)
    }


def _record(model: ProcessModel, record: RecordResult) -> dict[str, Any]:
    residuals = record.residuals
    return {
        "outputs": {
            name: {
                **errors,
                "residual_autocorrelation_in_band": float(residuals.white[j]),
                "residual_independent_of": {
                    signal: float(residuals.independent[j, i])
                    for i, signal in enumerate(model.input_names)
                    if residuals.tested[i]
                },
            }
            for j, (name, errors) in enumerate(errors_of(model, record.metrics).items())
        }
    }
