"""Comparison of models, seeds and linear baselines: which structure to believe."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.errors import ConfigError
from daq.files import write_whole
from daq.identification.campaign import (
    Group,
    Workers,
    distinct,
    groups_of,
    parse_seeds,
    run_all,
)
from daq.identification.fit import check_writable, default_folder, tell_replaced
from daq.identification.request import PARAMETERS, SettingsRequest
from daq.identification.result import Identification
from daq.identification.settings import problems_of
from daq.lookup.models import without_folders
from daq.progress import Watch, ignore, warn
from daq.provenance import software_versions
from daq.views import Lines, Shown
from sysid import (
    Campaign,
    Candidate,
    Comparison,
    Dataset,
    ModelError,
    Outcome,
    Output,
    ProcessModel,
    Spread,
)
from sysid import compare as compare_candidates
from sysid.arrays import FloatArray
from sysid.judging.comparison import Row
from sysid.linear import ARMAX, ARX, OE, Orders, tuned
from sysid.problem.regressors import with_regressors

COMPARISON = "comparison.yaml"
_FORMULA = (
    "AIC = n_e ln det S + 2 k, BIC = n_e ln det S + k ln n_e; S: mean square of the training "
    "residuals of all outputs, n_e: independent samples they are worth, k: determined parameters"
)


@dataclass(frozen=True)
class ComparisonRequest:
    """Structures to be compared on logs: models by name, linear baselines, several seeds.

    baselines: ``ARX``, ``ARMAX``, ``OE``. seeds: ``0:10`` for 0 to 9, or ``3,5,8``.

    >>> ComparisonRequest([Path("runs/a")], models=["actuator"], baselines=["ARX"]).seeds is None
    True
    """

    logs: Sequence[Path]
    validate: Sequence[Path] = ()
    models: Sequence[str] = ()
    baselines: Sequence[str] = ()
    seeds: str | None = None
    settings: SettingsRequest = field(default_factory=SettingsRequest)
    workers: Workers = field(default_factory=Workers)
    out: Path | None = None


@dataclass(frozen=True, repr=False)
class SeedsResult(Shown):
    """One structure identified with several seeds: the best run, and all of them."""

    best: Identification
    campaign: Campaign

    @property
    def headline(self) -> str:
        """How many seeds, and the best of them."""
        return f"best of {len(self.campaign.outcomes)} seeds: {self.best.headline}"

    def lines(self) -> Lines:
        """The best one's parameters with their 95 % intervals."""
        return self.best.lines()


@dataclass(frozen=True, repr=False)
class ComparisonResult(Shown):
    """Structures ranked by validation.

    group: the logs, as the first model used them. candidates: with their free runs. files:
    parameters by model. models: the names by which they are found from any folder, by those that
    are shown. request_words: what the command line named besides models and logs.

    >>> from daq import ComparisonRequest, compare, record
    >>> quick = SettingsRequest(options={"preset": "thesis", "generations": 3})
    >>> logs = [record("prbs.yaml").folder], [record("prbs.yaml", validation=True).folder]
    >>> result = compare(ComparisonRequest(*logs, baselines=["ARX"], settings=quick))
    >>> result.comparison.preferred, result.file.name
    ('actuator', 'comparison.yaml')
    """

    comparison: Comparison
    group: Group
    candidates: Sequence[Candidate]
    campaign: Campaign
    files: Mapping[str, Path]
    models: Mapping[str, str]
    folder: Path
    request_words: Sequence[str]

    @property
    def headline(self) -> str:
        """What it comes to."""
        return self.comparison.verdict

    @property
    def outputs(self) -> Sequence[str]:
        """Names of the outputs."""
        return self.group.problem.model.output_names

    @property
    def n_left_out(self) -> int:
        """Samples at the beginning of each log that no error counts: linear models start there."""
        return max(candidate.n_lags for candidate in self.candidates)

    @property
    def file(self) -> Path:
        """Where the document was written."""
        return self.folder / COMPARISON

    @cached_property
    def document(self) -> dict[str, Any]:
        """What ``comparison.yaml`` holds."""
        comparison, campaign, group = self.comparison, self.campaign, self.group
        spreads = {spread.model: spread for spread in campaign.spread()}
        structures = []
        for row in comparison.rows:
            entry = _row_document(row, group.problem.model.outputs)
            if row.name in spreads:
                entry["seeds"] = _spread_document(spreads[row.name])
                entry["parameters_file"] = str(self.files[row.name])
            structures.append(entry)
        return {
            "preferred": comparison.preferred,
            "verdict": comparison.verdict,
            "validated": comparison.validated,
            "training": [str(log.path) for log in group.training],
            "validation": [str(log.path) for log in group.validation],
            "structures": structures,
            "samples_left_out": self.n_left_out,
            "criteria": {
                "formula": _FORMULA,
                "samples": comparison.n_samples,
                "independent_samples": comparison.n_independent,
            },
            "failed": [f"{o.run.name}, seed {o.run.seed}: {o.problem}" for o in campaign.failed],
            "interrupted": campaign.interrupted,
            "software": software_versions(),
        }


def compare(wanted: ComparisonRequest, watch: Watch = ignore) -> ComparisonResult | SeedsResult:
    """Identify every structure from the logs and rank them; of one with several seeds the best.

    Raises ConfigError.

    >>> both = SettingsRequest(options={"seed": 1})
    >>> compare(ComparisonRequest([Path("runs/today")], seeds="0:3", settings=both))
    Traceback (most recent call last):
    daq.errors.ConfigError: --seed and --seeds: give one of them
    """
    if wanted.seeds is not None and wanted.settings.options.get("seed") is not None:
        raise ConfigError("--seed and --seeds: give one of them")
    logs = [*wanted.logs, *wanted.validate]
    names = distinct(wanted.models)
    problems = problems_of(wanted.settings, names, watch, logs_of=[logs] * len(names))
    seeds = parse_seeds(wanted.seeds) or [problems[0].settings.seed]
    alone = len(problems) == 1 and not wanted.baselines
    name = problems[0].model.name if alone else "comparison"
    folder = wanted.out or default_folder(wanted.logs, name)
    if wanted.out is None and not alone:
        folder = folder.with_name("comparison")
    check_writable(folder)
    tell_replaced(folder / (PARAMETERS if alone else COMPARISON), watch)
    shown = without_folders(problem.model_name for problem in problems)
    groups = [
        groups_of(p, shown[p.model_name], wanted.logs, wanted.validate, together=True)[0]
        for p in problems
    ]
    _require_same_outputs(groups)
    campaign = run_all(groups, seeds, wanted.workers, watch, lambda outcome: None)
    best = {name: outcome for (name, _), outcome in campaign.best().items()}
    fitted = [g for g in groups if g.model_name in best]
    if alone:
        result = fitted[0].result(best[fitted[0].model_name])
        (spread,) = campaign.spread()
        result = replace(result, folder=folder, seeds=_spread_document(spread))
        result.save(folder)
        return SeedsResult(result, campaign)
    candidates = _candidates(fitted, best, wanted.baselines, watch)
    ranking = _rank(fitted[0], candidates)
    files = {
        name: group.result(best[name]).save(folder / _folder_name(place, name))
        for place, group in enumerate(fitted, 1)
        if (name := group.model_name)
    }
    words = [f"--{name.lower()}" for name in wanted.baselines]
    words += ["--seeds", wanted.seeds] if wanted.seeds is not None else ["--seed", f"{seeds[0]}"]
    models = {group.model_name: group.problem.model_name for group in fitted}
    compared = ComparisonResult(
        ranking, groups[0], candidates, campaign, files, models, folder, words
    )
    text = yaml.safe_dump(dict(compared.document), sort_keys=False, allow_unicode=True)
    write_whole(compared.file, text)
    return compared


def _require_same_outputs(groups: Sequence[Group]) -> None:
    first = groups[0].problem
    for group in groups[1:]:
        problem = group.problem
        if problem.model.output_names != first.model.output_names:
            outputs, others = (", ".join(p.model.output_names) for p in (first, problem))
            raise ConfigError(
                f"{first.model_name} has the outputs {outputs}, {problem.model_name} {others}",
                cure="to be compared they must have the same, chosen with 'outputs' in a file "
                "given with --config",
                key="--model",
            )


def _candidates(
    groups: Sequence[Group], best: Mapping[str, Outcome], baselines: Sequence[str], watch: Watch
) -> list[Candidate]:
    """Every structure fitted, with its free runs."""
    candidates = []
    for group in groups:
        name = group.model_name
        estimator = best[name].estimator
        assert estimator is not None
        candidates.append(Candidate.of(name, estimator, *group.datasets))
    for kind in baselines:
        for extended in (False, True) if kind == "OE" else (False,):
            try:
                candidates += _linear(kind, groups[0], extended)
            except ModelError as error:
                warn(watch, f"{kind} is left out: {error}")
    return candidates


def _linear(kind: str, group: Group, extended: bool) -> list[Candidate]:
    """A linear model of chosen orders; extended: with the model's regressors, none without any."""
    training, validation = group.datasets
    names: tuple[str, ...] = ()
    if extended:
        model = group.problem.model
        (training, names), (validation, _) = (
            _extended(model, records) for records in (training, validation)
        )
        if not names:
            return []
    estimator = {"ARX": ARX(stable=True), "ARMAX": ARMAX(stable=True), "OE": OE()}[kind]
    selection = tuned(estimator, training)
    name = "+".join((f"{kind}:{_orders_text(selection.best.orders)}", *names))
    return [Candidate.of(name, selection.model, training, validation)]


def _extended(
    model: ProcessModel, records: Sequence[Dataset]
) -> tuple[list[Dataset], tuple[str, ...]]:
    extended = [with_regressors(model, record) for record in records]
    return [record for record, _ in extended], extended[0][1] if extended else ()


def _orders_text(orders: Orders) -> str:
    """``nf=2/4,nb=1``: an output's own orders between slashes, in the outputs' order."""
    each = {k: order if isinstance(order, list) else [order] for k, order in orders.items()}
    texts = {k: o[:1] if len(set(o)) == 1 else o for k, o in each.items()}
    return ",".join(f"{k}={'/'.join(map(str, o))}" for k, o in texts.items())


def _rank(group: Group, candidates: Sequence[Candidate]) -> Comparison:
    by_name, names = group.problem.settings.weights, group.problem.model.output_names
    weights = np.array([by_name.get(name, 1.0) for name in names])
    try:
        return compare_candidates(candidates, *group.datasets, weights=weights)
    except ModelError as error:
        raise ConfigError(str(error)) from None


def _row_document(row: Row, outputs: Sequence[Output]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": row.name,
        "verdict": row.verdict,
        "free_parameters": row.n_free,
        "effective_parameters": row.n_effective,
        "training_error": row.training_error,
        "training_rmse_absolute": _by_output(outputs, row.training_rmse_absolute),
        "daic": row.daic,
        "dbic": row.dbic,
    }
    if not np.isnan(row.rmse).all():
        figures = {"rmse": row.rmse, "msd": row.msd, "fit_percent": row.fit}
        figures["rmse_absolute"] = row.rmse_absolute
        entry["outputs"] = {
            output.name: {key: float(values[j]) for key, values in figures.items()}
            | {"unit": output.unit}
            for j, output in enumerate(outputs)
        }
    if row.ratio is not None:
        entry["squared_errors_relative"] = {
            "value": row.ratio.value,
            "interval_95": [row.ratio.low, row.ratio.high],
            "p_value": row.ratio.p_value,
        }
    return entry


def _by_output(outputs: Sequence[Output], values: FloatArray) -> dict[str, float]:
    return {output.name: float(value) for output, value in zip(outputs, values, strict=True)}


def _spread_document(spread: Spread) -> dict[str, Any]:
    figures = {k: getattr(spread, k) for k in ("runs", "failed", "best", "median", "worst")}
    return {**figures, "within_1_percent": spread.agreeing}


def _folder_name(place: int, name: str) -> str:
    """A folder for a model's results: its place, and what of its name a file system takes."""
    last = name.replace("\\", "/").rpartition("/")[2]
    return f"{place}-" + re.sub(r"[^A-Za-z0-9.=,-]+", "-", last)[:80]
