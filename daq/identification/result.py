"""The result of an identification, and its document: what machines read of it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from daq.config.identification import Signals
from daq.files import make_folder, write_whole
from daq.identification.records import LoggedRecord
from daq.identification.request import resume_command
from daq.identification.rows import Rows
from daq.identification.settings import Problem
from daq.provenance import software_versions
from sysid import Metrics, ProcessModel
from sysid.arrays import FloatArray
from sysid.gassi import GASSI
from sysid.judging.assessment import RecordResult, Verdict, judge
from sysid.problem.model import Parameter
from sysid.uncertainty import Estimate, Profile, Uncertainty

if TYPE_CHECKING:
    import pandas as pd

PARAMETERS = "parameters.yaml"


@dataclass(frozen=True)
class FittedLog:
    """A log with the identified model's free run on it, (n_samples, n_outputs), and its errors."""

    log: LoggedRecord
    run: FloatArray
    result: RecordResult


@dataclass(frozen=True)
class Identification:
    """Parameters identified from logs, and how far to trust them.

    uncertainty: None where the search was not refined to a minimum. profiles: those asked for.
    folder: where ``parameters.yaml`` was written, None where nothing was. seeds: the spread over
    several seeds, of which this is the best.

    >>> from daq import identify, record
    >>> result = identify(record("prbs.yaml"), population=16, generations=2)
    >>> result.save("results").name, list(result.metrics.columns)
    ('parameters.yaml', ['rmse', 'msd', 'fit_percent'])
    """

    problem: Problem
    estimator: GASSI
    uncertainty: Uncertainty | None
    profiles: Sequence[Profile]
    training: Sequence[FittedLog]
    validation: Sequence[FittedLog]
    folder: Path | None = None
    seeds: Mapping[str, Any] | None = None

    @property
    def model(self) -> ProcessModel:
        """The process model, as it was used."""
        return self.problem.model

    @cached_property
    def verdict(self) -> Verdict:
        """How far to trust it, and why."""
        return judge(
            self.model,
            [log.result for log in self.training],
            [log.result for log in self.validation],
            self.uncertainty,
            self.estimator.feasible_,
        )

    @property
    def trust(self) -> str:
        """The verdict in one word."""
        return self.verdict.trust

    @property
    def reasons(self) -> tuple[str, ...]:
        """What the verdict rests on."""
        return tuple(self.verdict.reasons)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the search before its time."""
        return self.estimator.stopped_ == "interrupted"

    @property
    def resume_command(self) -> str | None:
        """What to type to continue an interrupted search; None where there is nothing to."""
        return resume_command(self.folder) if self.interrupted and self.folder else None

    @property
    def parameters_file(self) -> Path | None:
        """Where the parameters were written."""
        return self.folder / PARAMETERS if self.folder is not None else None

    @cached_property
    def document(self) -> dict[str, Any]:
        """What ``parameters.yaml`` holds, and ``rig identify --json`` prints beside the files."""
        return _document(self)

    @cached_property
    def rows(self) -> Rows:
        """The document's tables."""
        return Rows.of(self.document)

    @property
    def parameters(self) -> pd.DataFrame:
        """A row for each parameter: value, low and high end of its 95 % interval, unit.

        NaN where there is no interval, and why as a note: such a parameter is not to be used by
        itself.
        """
        import pandas as pd

        nothing = (float("nan"), float("nan"))
        rows = {
            row.name: {
                "value": row.value,
                **dict(zip(("low", "high"), row.interval or nothing, strict=True)),
                "unit": row.unit,
                "note": row.undetermined_label,
            }
            for row in self.rows.parameters
        }
        return pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")

    @property
    def metrics(self) -> pd.DataFrame:
        """Errors of the free runs, a row for each part, log and output.

        rmse and msd in parts of the largest measured value, fit_percent 100 for a perfect one.
        """
        import pandas as pd

        rows = [
            {"part": part, "log": log.name, "output": output, **errors.figures}
            for part, logs in self.rows.logs.items()
            for log in logs
            for output, errors in log.outputs.items()
        ]
        return pd.DataFrame(rows).set_index(["part", "log", "output"])

    def save(self, folder: str | Path) -> Path:
        """Write ``parameters.yaml`` into a folder; its path. Raises ConfigError."""
        make_folder(Path(folder))
        path = Path(folder) / PARAMETERS
        text = yaml.safe_dump(self.document, sort_keys=False, allow_unicode=True)
        write_whole(path, text)
        return path

    def source(self, name: str) -> str:
        """Where a parameter's range or value comes from."""
        if name in self.problem.sources:
            return self.problem.sources[name]
        guess = self.estimator.guesses_.get(name)
        return guess.source if guess is not None else "model"

    def estimate(self, name: str) -> Estimate | None:
        """Value and interval of a free parameter; None where there was no refinement."""
        estimates = self.uncertainty.parameters if self.uncertainty is not None else ()
        return next((e for e in estimates if e.name == name), None)

    def on_bound(self, name: str) -> bool:
        """Whether a free parameter is held by an end of its range."""
        if (estimate := self.estimate(name)) is not None:
            return estimate.why == "bound"
        space = self.estimator.space_
        return bool(space.on_bound(self.estimator.chromosome_)[space.names.index(name)])


def _document(identification: Identification) -> dict[str, Any]:
    estimator, problem = identification.estimator, identification.problem
    settings, verdict = problem.settings, identification.verdict
    parts = {"training": identification.training, "validation": identification.validation}
    return {
        "model": problem.model_name,
        **_signals(settings),
        "verdict": {"trust": verdict.trust, "reasons": list(verdict.reasons)},
        "parameters": {p.name: _parameter(identification, p) for p in problem.model.parameters},
        **({"initial_states": starts} if any(starts := estimator.initial_states_) else {}),
        **_uncertainty(identification.uncertainty),
        **_profiles(identification.profiles),
        "error": {
            "value": estimator.error_,
            "meaning": "mean over outputs of the RMSE on outputs normalised by max|y|",
            "before_refinement": estimator.search_error_,
        },
        "metrics": {
            part: [
                {
                    "log": str(log.log.path),
                    "name": log.result.name,
                    "outputs": _outputs(problem.model, log.result),
                }
                for log in logs
            ]
            for part, logs in parts.items()
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
        **({"seeds": dict(identification.seeds)} if identification.seeds is not None else {}),
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


def _parameter(identification: Identification, parameter: Parameter) -> dict[str, Any]:
    name, estimator = parameter.name, identification.estimator
    entry: dict[str, Any] = {"value": estimator.parameters_[name], "unit": parameter.unit}
    space, tied = estimator.space_, identification.problem.settings.tied
    if name in space.names:
        searched = space.parameters[space.names.index(name)]
        entry["range"] = [searched.lower, searched.upper]
        entry["scale"] = searched.scale
        entry["on_bound"] = identification.on_bound(name)
        if (estimate := identification.estimate(name)) is not None:
            entry |= _interval(estimate)
    elif name in tied:
        entry["tied"] = tied[name]
    else:
        entry["fixed"] = True
    entry["source"] = identification.source(name)
    return entry


def _interval(estimate: Estimate) -> dict[str, Any]:
    if estimate.why:
        return {"undetermined": estimate.why}
    assert estimate.std is not None and estimate.low is not None and estimate.high is not None
    return {"std": float(estimate.std), "interval": [float(estimate.low), float(estimate.high)]}


def _uncertainty(uncertainty: Uncertainty | None) -> dict[str, Any]:
    if uncertainty is None:
        return {}
    names = [parameter.name for parameter in uncertainty.parameters]
    correlation = uncertainty.correlation()
    pairs = [
        {"parameters": [names[i], names[j]], "correlation": round(float(correlation[i, j]), 4)}
        for i, j in itertools.combinations(range(len(names)), 2)
        if np.isfinite(correlation[i, j])
        and not (uncertainty.parameters[i].why or uncertainty.parameters[j].why)
    ]
    return {
        "determined_directions": uncertainty.rank,
        "singular_values": [float(f"{value:.4g}") for value in uncertainty.singular_values],
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
            for ambiguity in uncertainty.ambiguities
        ],
        **({"rivals": [dict(rival) for rival in uncertainty.rivals]} if uncertainty.rivals else {}),
        "correlations": pairs,
    }


def _profiles(profiles: Sequence[Profile]) -> dict[str, Any]:
    if not profiles:
        return {}
    return {
        "profiles": {
            profile.name: {
                "interval": [profile.low, profile.high],
                "values": profile.values.tolist(),
                "statistic": profile.statistic.tolist(),
            }
            for profile in profiles
        }
    }


def errors_document(model: ProcessModel, metrics: Metrics) -> dict[str, dict[str, float]]:
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


def _outputs(model: ProcessModel, record: RecordResult) -> dict[str, dict[str, Any]]:
    residuals = record.residuals
    return {
        name: {
            **errors,
            "residual_autocorrelation_in_band": float(residuals.white[j]),
            "residual_independent_of": {
                signal: float(residuals.independent[j, i])
                for i, signal in enumerate(model.input_names)
                if residuals.tested[i]
            },
        }
        for j, (name, errors) in enumerate(errors_document(model, record.metrics).items())
    }
