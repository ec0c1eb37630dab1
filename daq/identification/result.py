"""The result of an identification, and its document: what machines read of it."""

from __future__ import annotations

import itertools
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from daq.config.identification import Signals, TermSetting
from daq.files import make_folder, write_whole
from daq.identification.further_runs import design_command, hardly_known, knowledge
from daq.identification.records import LoggedRecord
from daq.identification.remedies import remedies
from daq.identification.request import PARAMETERS, resume_command
from daq.identification.rows import Rows
from daq.identification.settings import Problem, setting_of
from daq.lookup.models import title_of, trust_option, without_folders
from daq.notation import quantity
from daq.provenance import software_versions
from daq.views import Lines, Shown
from sysid import Metrics, ProcessModel
from sysid.arrays import FloatArray
from sysid.problem.data import Dataset
from sysid.problem.faults import DataFault
from sysid.problem.model import Parameter

if TYPE_CHECKING:
    import pandas as pd

    from daq.identification.verdict import ShownVerdict
    from sysid.gassi import GASSI
    from sysid.judging.assessment import RecordResult, Verdict
    from sysid.judging.examination import Suspicion
    from sysid.judging.starts import Starts
    from sysid.uncertainty import Estimate, Profile, Uncertainty


_EXPLAINED = 80.0  # fit [%] of training, above which a search did not get stuck
_NOT_OF_DESIGNS = {"outputs", "terms", "channels"}  # they change the model, and are in no result
_RMSE = "mean over outputs of the RMSE on outputs normalised by max|y|"
_CEGA = "mean over outputs of squares by range, weighed by the size of the velocity (4.6)"


class _Row(list[float]):
    """Numbers that stand in one line of a YAML file."""


yaml.SafeDumper.add_representer(
    _Row, lambda dumper, row: dumper.represent_sequence("tag:yaml.org,2002:seq", row, True)
)


@dataclass(frozen=True, repr=False)
class FittedLog(Shown):
    """A log with the identified model's free run on it, (n_samples, n_outputs), and its errors."""

    log: LoggedRecord
    run: FloatArray
    result: RecordResult

    @property
    def headline(self) -> str:
        """Its name and length, and the fit of each output."""
        fits = ", ".join(f"{fit:.1f}" for fit in self.result.metrics.fit)
        return f"{self.log.headline}, fit {fits} %"


@dataclass(frozen=True)
class NextStep:
    """What makes an identification better, and what to type for it."""

    purpose: str
    command: str


@dataclass(frozen=True, repr=False)
class Identification(Shown):
    """Parameters identified from logs, and how far to trust them.

    uncertainty: None where the search was not refined to a minimum. profiles: those asked for.
    folder: where ``parameters.yaml`` was written, None where nothing was. seeds: the spread over
    several seeds, of which this is the best. faults: what is wrong with the data. suspicion: what
    the model may lack, None where that was not tested.

    >>> from daq import identify, record
    >>> result = identify(record("prbs.yaml"), preset="thesis", generations=2)
    >>> result.save("results").name, list(result.metrics.columns)
    ('parameters.yaml', ['fit_percent', 'rmse_absolute', 'rmse', 'msd', 'msd_absolute', 'unit'])
    """

    problem: Problem
    estimator: GASSI
    uncertainty: Uncertainty | None
    profiles: Sequence[Profile]
    training: Sequence[FittedLog]
    validation: Sequence[FittedLog]
    folder: Path | None = None
    seeds: Mapping[str, Any] | None = None
    faults: tuple[DataFault, ...] = ()
    suspicion: Suspicion | None = None

    @property
    def headline(self) -> str:
        """The model, its logs, and what may be used."""
        names = ", ".join(log.name for logs in self.rows.logs.values() for log in logs)
        model = self.problem.model_name
        return f"{without_folders([model])[model]} from {names}: {self.verdict.headline}"

    def lines(self) -> Lines:
        """Parameters and combinations with their 95 % intervals, and fits."""
        return self.rows.lines()

    @property
    def title(self) -> str:
        """What to call the model."""
        return title_of(self.problem.model_name, self.model)

    @property
    def model(self) -> ProcessModel:
        """The process model, as it was used."""
        return self.problem.model

    @cached_property
    def verdict(self) -> ShownVerdict:
        """How well outputs are predicted, whether parameters may be used, and why."""
        from daq.identification.verdict import ShownVerdict
        from sysid.judging.assessment import judge

        parts, suspicion = (self.training, self.validation), self.suspicion
        training, validation = ([log.result for log in part] for part in parts)
        verdict = judge(
            self.model,
            training,
            validation,
            self.uncertainty,
            self.estimator.feasible_,
            faults=self.faults,
            findings=None if suspicion is None else suspicion.findings,
            alternative=None if suspicion is None else suspicion.alternative,
            unseen=() if suspicion is None else suspicion.unseen,
        )
        return ShownVerdict(verdict.predicted, verdict.parameters, verdict.notes)

    @property
    def trust(self) -> str:
        """The verdict in one word, of predictions or of parameters, whichever is the lesser."""
        return self.verdict.trust

    @property
    def reasons(self) -> tuple[str, ...]:
        """What the verdict rests on."""
        return self.verdict.reasons

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the search before its time."""
        return self.estimator.stopped_ == "interrupted"

    @property
    def trust_option(self) -> str:
        """`` --trust`` where commands that read this result need it, to run the model's file."""
        return trust_option(self.problem.model_name)

    @property
    def resume_command(self) -> str | None:
        """What to type to continue an interrupted search; None where there is nothing to."""
        if not self.interrupted or self.folder is None:
            return None
        return f"{resume_command(self.folder)}{self.trust_option}"

    @property
    def alternative_command(self) -> str | None:
        """What to type to identify what explains the data better; None for nothing."""
        alternative = None if self.suspicion is None else self.suspicion.alternative
        if alternative is None or not alternative.better:
            return None
        if alternative.terms:
            terms = [*self.problem.settings.terms, *map(setting_of, alternative.terms)]
            return self._again(f"terms={_in_one_line(terms)}")
        if self.trust_option:
            return None
        name = self.problem.model_name
        return self._again(model=f"{name}{',' if ':' in name else ':'}{alternative.name}")

    @property
    def remedy(self) -> NextStep | None:
        """Identifying without what is wrong with data or ranges; None for nothing."""
        settings = remedies(
            self.problem.settings,
            {s.name: s.unit for s in self.model.inputs}
            | {s.name: s.unit for s in self.model.outputs},
            faults=self.faults,
            findings=() if self.suspicion is None else self.suspicion.findings,
            pushed=self._pushed,
            starts=[
                start
                for log in (*self.training, *self.validation)
                if log.result.starts is not None
                for start in log.result.starts.estimates
            ],
        )
        if not settings:
            return None
        purpose = "Identify again without what was found wrong with data or ranges"
        if units := [s for s in settings if s.partition("=")[0].endswith(".unit")]:
            purpose += (
                f" ({', '.join(units)} is a guess by the size of a gain: look at the file, for a "
                "sensor's scale may be wrong as well)"
            )
        return NextStep(f"{purpose}:", self._again(*settings))

    @property
    def _pushed(self) -> dict[str, tuple[float, float, float]]:
        """Value and range of parameters that the data want beyond an end of a logarithmic one."""
        if self.uncertainty is None:
            return {}
        free = zip(self.estimator.space_.parameters, self.uncertainty.parameters, strict=True)
        return {
            p.name: (estimate.value, p.lower, p.upper)
            for p, estimate in free
            if estimate.pushed and p.scale == "log" and p.name in self.model.parameter_names
        }

    @property
    def next_step(self) -> NextStep | None:
        """What makes this identification better, and what to type for it; None for nothing."""
        alternative = self.suspicion.alternative if self.suspicion is not None else None
        if alternative is not None and (command := self.alternative_command) is not None:
            return NextStep(
                f"Identify with {alternative.name}, which explains these data better:", command
            )
        if (remedy := self.remedy) is not None:
            return remedy
        if self._fits_training_alone and not self.interrupted:
            return NextStep(
                "See whether any parameters explain what was held back as well:", self._all_in_one
            )
        if self._searched_in_vain and not self.interrupted:
            settings = self.problem.settings
            longer = {"seed": settings.seed + 1, "population": 2 * settings.population}
            return NextStep("Search longer, and from elsewhere:", self._again(**longer))
        return None if self.interrupted else self._further_runs

    @property
    def _further_runs(self) -> NextStep | None:
        """Runs that tell what these data hardly do; None for nothing, and without a known rig."""
        wide = [] if self.uncertainty is None else hardly_known(self.uncertainty)
        typed = {s.partition("=")[0] for s in self.problem.request.settings}
        if not wide or self.folder is None or typed & _NOT_OF_DESIGNS:
            return None
        request, model = self.problem.request, self.problem.model_name
        more = request.config_words
        more += ["--model", model] if self.trust_option else []  # named, it needs no trust
        logs = [fitted.log.path for fitted in self.training]
        command = design_command(self.folder, logs, more)
        if command is None:
            return None
        purpose = f"{knowledge(wide)}. To design runs that would narrow them:"
        return NextStep(purpose, command)

    @property
    def _fits_training_alone(self) -> bool:
        """Whether training is explained so well that no longer search would better validation."""
        fits = [log.result.metrics.fit for log in self.training]
        poor = self.verdict.predicted.trust == "poor" and bool(self.validation)
        return poor and bool(np.nanmin(fits) > _EXPLAINED)

    @property
    def _all_in_one(self) -> str:
        """The command of this identification with nothing held back."""
        logs = dict.fromkeys(str(log.log.path) for log in (*self.training, *self.validation))
        request = self.problem.request
        as_option = request.options.get("hold_back") is not None
        nothing = ["hold_back=0"] if self.problem.settings.hold_back and not as_option else []
        return shlex.join(["rig", "identify", *logs, *request.words(nothing, hold_back=None)])

    @property
    def _searched_in_vain(self) -> bool:
        """Whether what was found can hardly be the plant's, for all that is known of the data."""
        from sysid.judging.assessment import coloured_innovations

        findings = () if self.suspicion is None else self.suspicion.findings
        if any(finding.is_hidden and finding.counts for finding in findings):
            return False  # no values make up for a state that the model has not
        if self.verdict.predicted.trust == "poor":
            return True
        return self.uncertainty is not None and bool(coloured_innovations(self.uncertainty).any())

    def _again(self, *settings: str, **options: Any) -> str:
        """The command of this identification with other settings and options."""
        logs, checks = (
            list(dict.fromkeys(str(fitted.log.path) for fitted in part))
            for part in (self.training, self.validation)
        )
        words = ["rig", "identify", *logs]
        words += [word for path in checks if path not in logs for word in ("--validate", path)]
        return shlex.join([*words, *self.problem.request.words(settings, **options)])

    @property
    def parameters_file(self) -> Path | None:
        """Where the parameters were written."""
        return self.folder / PARAMETERS if self.folder is not None else None

    @cached_property
    def document(self) -> dict[str, Any]:
        """What ``parameters.yaml`` holds, and ``rig identify --json`` prints beside the files."""
        from sysid.gassi import PRESETS

        estimator, settings, verdict = self.estimator, self.problem.settings, self.verdict
        signals = settings.model_dump(mode="json", include=set(Signals.model_fields))
        starts = estimator.initial_states_
        profiles = {profile.name: _profile(profile) for profile in self.profiles}
        assumptions = self.model.assumptions
        return {
            "model": self.problem.model_name,
            **({"assumptions": list(assumptions)} if assumptions else {}),
            # How the model was used where not as it declares; ``rig replay`` uses it likewise.
            **{key: value for key, value in signals.items() if value},
            "criterion": {
                "name": estimator.criterion_,
                "reason": estimator.criterion_reason_,
                **({"noise": noise} if (noise := filter_noise(estimator)) else {}),
            },
            **({"averaged": averaged} if (averaged := _averaged(self)) else {}),
            **({"preparation": prepared} if (prepared := _preparation(self)) else {}),
            "verdict": _verdict(verdict),
            **({"next": asdict(self.next_step)} if self.next_step is not None else {}),
            **({"missing": _missing(self)} if self.suspicion is not None else {}),
            "data_faults": [_fault(fault) for fault in self.faults],
            "parameters": {p.name: _parameter(self, p) for p in self.model.parameters},
            **({"initial_states": starts} if any(starts) else {}),
            **_uncertainty(self.uncertainty, self.model.output_names),
            **({"profiles": profiles} if profiles else {}),
            "error": {
                "value": estimator.error_,
                "meaning": _CEGA if PRESETS[estimator.preset].squares else _RMSE,
                "before_refinement": estimator.search_error_,
            },
            "metrics": {
                "training": [_log(self.model, log) for log in self.training],
                "validation": [_log(self.model, log) for log in self.validation],
            },
            "search": {
                **{key: getattr(settings, key) for key in ("preset", "seed", "population")},
                "generations": len(estimator.history_),
                "simulations": estimator.n_simulations_,
                **({"excerpt": excerpt} if (excerpt := _excerpt(self)) else {}),
                "stopped": estimator.stopped_,
                "flagged": estimator.flagged_,
                "feasible": estimator.feasible_,
            },
            "software": software_versions(),
            **({"seeds": dict(self.seeds)} if self.seeds is not None else {}),
        }

    @cached_property
    def rows(self) -> Rows:
        """The document's tables."""
        return Rows.of(self.document)

    @property
    def parameters(self) -> pd.DataFrame:
        """A row for each parameter: value, low and high end of its 95 % interval, unit.

        NaN where the data set no end; of a parameter without any the note says why: it is not to
        be used by itself.
        """
        import pandas as pd

        rows = {
            row.name: [row.value, *_numbers(row.interval), row.unit, row.undetermined_label]
            for row in self.rows.parameters
        }
        columns = ["value", "low", "high", "unit", "note"]
        table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
        return table.rename_axis("parameter")

    @property
    def metrics(self) -> pd.DataFrame:
        """Errors of the free runs, a row for each part, log and output.

        rmse and msd in parts of the largest measured value, rmse_absolute and msd_absolute in the
        output's unit, fit_percent 100 for a perfect one. A narrow terminal shows all columns by
        ``print(result.metrics.to_string())``.
        """
        import pandas as pd

        table = pd.DataFrame(self.rows.errors).set_index(["part", "log", "output"])
        first = ["fit_percent", "rmse_absolute"]  # which a narrow terminal is to show
        return table[[*first, *(name for name in table if name not in first)]]

    def save(self, folder: str | Path) -> Path:
        """Write ``parameters.yaml`` into a folder; its path. Raises ConfigError."""
        make_folder(Path(folder))
        path = Path(folder) / PARAMETERS
        write_whole(path, yaml.safe_dump(self.document, sort_keys=False, allow_unicode=True))
        return path


def _in_one_line(terms: Sequence[TermSetting]) -> str:
    entries = [term.model_dump(mode="json", exclude_defaults=True) for term in terms]
    text = yaml.safe_dump(entries, default_flow_style=True, sort_keys=False, width=math.inf)
    return text.strip()


def _fault(fault: DataFault) -> dict[str, Any]:
    return {**asdict(fault), "records": list(fault.records), "sentence": fault.sentence}


def _verdict(verdict: Verdict) -> dict[str, Any]:
    statements = {"predictions": verdict.predicted, "parameters": verdict.parameters}
    return {
        "trust": verdict.trust,
        "reasons": list(verdict.reasons),
        **{k: {"trust": s.trust, "reasons": list(s.reasons)} for k, s in statements.items()},
        "notes": list(verdict.notes),
    }


def _missing(identification: Identification) -> dict[str, Any]:
    """What score tests found, and the variant that was fitted for it."""
    from sysid.judging.findings import description

    suspicion, command = identification.suspicion, identification.alternative_command
    assert suspicion is not None
    alternative = suspicion.alternative
    document: dict[str, Any] = {
        "findings": [
            {
                "what": description(finding),
                "kind": finding.kind,
                "name": finding.name,
                **({"of": finding.term.of} if finding.term is not None else {}),
                "amplitude": finding.amplitude,
                "p_value": float(f"{finding.p_value:.3g}"),
                "moves": {
                    move.quantity.name: {
                        "from": float(move.quantity.value),
                        "to": float(move.quantity.value + move.change),
                        "standard_deviations": round(float(move.deviations), 3),
                    }
                    for move in finding.moves
                },
            }
            for finding in suspicion.findings
        ]
    }
    if alternative is not None:
        document["fitted"] = {
            "name": alternative.name,
            "better": bool(alternative.better),
            **({"command": command} if command is not None else {}),
            "fit_percent": {k: list(pair) for k, pair in alternative.fits.items()},
            "values": {
                name: {"from": float(old), "to": float(new), "unit": unit}
                for name, (old, new, unit) in alternative.values.items()
            },
        }
    return document


def _parameter(identification: Identification, parameter: Parameter) -> dict[str, Any]:
    name, estimator, problem = parameter.name, identification.estimator, identification.problem
    entry: dict[str, Any] = {"value": estimator.parameters_[name], "unit": parameter.unit}
    if name in estimator.space_.names:
        entry |= _searched(identification, estimator.space_.names.index(name))
    elif name in problem.settings.tied:
        entry["tied"] = problem.settings.tied[name]
    else:
        entry["fixed"] = True
    guess = estimator.guesses_.get(name)
    entry["source"] = problem.sources.get(name, "model" if guess is None else guess.source)
    return entry


def _searched(identification: Identification, place: int) -> dict[str, Any]:
    """Range and interval of the free parameter at a place of the search space."""
    space, uncertainty = identification.estimator.space_, identification.uncertainty
    parameter = space.parameters[place]
    entry: dict[str, Any] = {"range": [parameter.lower, parameter.upper], "scale": parameter.scale}
    if uncertainty is None:
        on_bound = space.on_bound(identification.estimator.chromosome_)
        return {**entry, "on_bound": bool(on_bound[place])}
    estimate = uncertainty.parameters[place]
    ends = parameter.lower, parameter.upper
    end = min(ends, key=lambda end: abs(end - estimate.value))
    entry |= {"on_bound": estimate.on_bound, "pushed": estimate.pushed}
    if estimate.harmless:
        entry["harmless"] = True
    if estimate.on_bound and end in (parameter.minimum, parameter.maximum):
        entry["at_limit"] = True
    return {**entry, **_interval(estimate)}


def _interval(estimate: Estimate) -> dict[str, Any]:
    """What is said of a quantity beside its value."""
    ends = [None if end is None else float(end) for end in (estimate.low, estimate.high)]
    entry: dict[str, Any] = {"undetermined": estimate.why} if estimate.why else {"interval": ends}
    if estimate.why == "rival":
        entry["interval_here"] = ends
    if estimate.std is not None and not estimate.why:
        entry["std"] = float(estimate.std)
    if estimate.failing:
        entry["fails"] = estimate.failing
    return entry


def _numbers(interval: tuple[float | None, float | None] | None) -> tuple[float, float]:
    low, high = interval or (None, None)
    return float("nan") if low is None else low, float("nan") if high is None else high


def _uncertainty(uncertainty: Uncertainty | None, outputs: Sequence[str]) -> dict[str, Any]:
    if uncertainty is None:
        return {}
    determined = {k: e.name for k, e in enumerate(uncertainty.parameters) if not e.why}
    correlation = uncertainty.correlation()
    pairs = [
        {"parameters": [first, second], "correlation": round(float(correlation[i, j]), 4)}
        for (i, first), (j, second) in itertools.combinations(determined.items(), 2)
        if np.isfinite(correlation[i, j])
    ]
    rivals = [
        {
            "parameters": dict(rival.values),
            "intervals": {name: list(ends) for name, ends in rival.intervals.items()},
        }
        for rival in uncertainty.rivals
    ]
    of_filter = {  # none without a filter
        key: {name: round(float(v), 3) for name, v in zip(outputs, values, strict=True)}
        for key, values in (("succession", uncertainty.succession), ("bent", uncertainty.bent))
        if len(values)
    }
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
        **({"rivals": rivals} if rivals else {}),
        "correlations": pairs,
        "together": {
            "coverage": round(uncertainty.joint, 3),
            "widening": round(uncertainty.simultaneous, 3),
        },
        "disagreement": round(uncertainty.disagreement, 3),
        **of_filter,
        "covariance": _covariance(uncertainty),
    }


def _covariance(uncertainty: Uncertainty) -> dict[str, Any]:
    """A factor of the parameters' covariance, for a later stage of identification."""
    names = [estimate.name for estimate in uncertainty.parameters]
    return {
        "parameters": names,
        "meaning": "each row a change of one standard deviation, in the parameters' units, "
        "independent of the others; the covariance is the sum of their products",
        "factor": [_Row(float(f"{x:.6g}") for x in row) for row in uncertainty.factor],
    }


def _profile(profile: Profile) -> dict[str, Any]:
    return {
        "interval": [profile.low, profile.high],
        "values": profile.values.tolist(),
        "statistic": profile.statistic.tolist(),
    }


def errors_document(model: ProcessModel, metrics: Metrics) -> dict[str, dict[str, Any]]:
    """Errors of each output on one log: in parts of max|y|, and absolute in the output's unit."""
    figures = {"rmse": metrics.rmse, "msd": metrics.msd, "fit_percent": metrics.fit}
    figures["max_abs"] = metrics.scale
    return {
        output.name: {
            **{key: float(values[j]) for key, values in figures.items()},
            "rmse_absolute": float(metrics.rmse_absolute[j]),
            "msd_absolute": float(metrics.msd[j] * metrics.scale[j]),
            "unit": output.unit,
        }
        for j, output in enumerate(model.outputs)
    }


def _in_parts_of_noise(result: RecordResult, j: int) -> dict[str, float]:
    """How large an output's residuals are in parts of what a right model leaves, where known."""
    if result.floor is None or not result.floor.known[j]:
        return {}
    figures = {"ratio": result.floor.ratio[j], "p_value": result.floor.p_value[j]}
    return {f"residual_to_noise_{key}": float(f"{value:.4g}") for key, value in figures.items()}


def filter_noise(estimator: GASSI) -> dict[str, float]:
    """Noise of the outputs by which a filter judged a fit, in their units; empty without one."""
    return _by_output(estimator, estimator.output_noise_)


def least_noise(estimator: GASSI) -> dict[str, float]:
    """What it is at least, in their units; empty without a filter."""
    return _by_output(estimator, estimator.least_noise_)


def _by_output(estimator: GASSI, noise: FloatArray | None) -> dict[str, float]:
    if estimator.criterion_ != "innovations" or noise is None:
        return {}
    return dict(zip(estimator.simulator().model.output_names, map(float, noise), strict=True))


def _averaged(result: Identification) -> dict[str, str]:
    """Outputs that their sensor averages, and how that is met."""
    records = [log.log.dataset for log in (*result.training, *result.validation)]
    times = result.problem.selection.averaged
    return {
        name: f"its samples are means over {_window(times.get(name))}, and so are the model's"
        for j, name in enumerate(result.model.output_names)
        if any(record.windows.size and record.windows[:, j].any() for record in records)
    }


def _window(time: float | None) -> str:
    """Of an output, as a configuration says [s], or else as a run's counts show."""
    edges = "the time between two edges of the encoder"
    return edges if time is None else f"the {quantity(time, 's')} before each"


def _excerpt(result: Identification) -> dict[str, Any]:
    """What the search of long logs went by: samples, of how many, and rows counted from 1.

    fitted_to_all: whether its minima were fitted to all samples then.
    """
    excerpt = result.estimator.excerpt_
    if excerpt is None:
        return {}
    logs = [log.log for log in result.training]
    rows = [
        {"log": str(logs[part.place].path), "rows": [part.begin + 1, part.end]}
        for part in excerpt.parts
    ]
    total = sum(record.n_samples for record in excerpt.records)
    return {
        "samples": excerpt.n_samples,
        "of": total,
        "fitted_to_all": not excerpt.cut,
        "parts": rows,
    }


def _preparation(result: Identification) -> list[dict[str, Any]]:
    """What was done to each log before it was used; a log of which a part was held back once."""
    logs = {str(log.log.path): log.log for log in (*result.training, *result.validation)}
    return [
        {
            "log": path,
            "steps": list(log.preparation.steps),
            "before": _size(log.preparation.before),
            "after": _size(log.preparation.after),
            "start": log.preparation.start,
        }
        for path, log in logs.items()
        if log.preparation is not None
    ]


def _size(record: Dataset) -> dict[str, Any]:
    return {"samples": record.n_samples, "sample_time": record.dt}


def _log(model: ProcessModel, log: FittedLog) -> dict[str, Any]:
    """Errors and residual tests of each output on one log."""
    residuals, outputs = log.result.residuals, {}
    tested = np.flatnonzero(residuals.tested)
    for j, (name, errors) in enumerate(errors_document(model, log.result.metrics).items()):
        outputs[name] = {
            **errors,
            **_in_parts_of_noise(log.result, j),
            "residual_autocorrelation_in_band": float(residuals.white[j]),
            "residual_independent_of": {
                model.input_names[i]: float(residuals.independent[j, i]) for i in tested
            },
            "residual_independence_bands": {
                model.input_names[i]: float(residuals.cross_band[j, i]) for i in tested
            },
        }
    entry = {"log": str(log.log.path), "name": log.result.name, "outputs": outputs}
    return {**entry, **_starts(model, log.result.starts)}


def _starts(model: ProcessModel, starts: Starts | None) -> dict[str, Any]:
    """Where a free run started, by state, and its fits from the first sample instead."""
    if starts is None or not starts.estimates:
        return {}
    entries = {
        start.state: {
            "value": start.value,
            "unit": start.unit,
            **({"first_sample": start.first} if np.isfinite(start.first) else {}),
            "range": [start.low, start.high],
            "on_end": start.on_end,
        }
        for start in starts.estimates
    }
    if starts.first_fit is None:
        return {"starts": entries}
    fits = dict(zip(model.output_names, starts.first_fit.tolist(), strict=True))
    return {"starts": entries, "fit_percent_from_first_sample": fits}
