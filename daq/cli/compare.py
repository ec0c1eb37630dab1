"""``rig identify`` with several models, seeds or linear baselines: which structure to believe."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from daq.cli import identification as reporting
from daq.cli import terminal as console
from daq.cli.campaign import (
    Group,
    Workers,
    distinct,
    groups_of,
    note_warnings,
    parse_seeds,
    run_all,
)
from daq.cli.identify import check_writable, default_folder, publish_report, write_parameters
from daq.errors import ConfigError
from daq.files import write_whole
from daq.identification.result import document
from daq.identification.settings import prepare_models
from daq.provenance import software_versions
from sysid import Campaign, Candidate, Comparison, ModelError, Outcome, Spread, compare
from sysid.judging.comparison import Row
from sysid.linear import ARMAX, ARX, tuned

_FORMULA = (
    "AIC = n_e ln det S + 2 k, BIC = n_e ln det S + k ln n_e; S: mean square of the training "
    "residuals of all outputs, n_e: independent samples they are worth, k: determined parameters"
)


@dataclass(frozen=True)
class Ask:
    """What is to be compared: models by name, and linear baselines (``ARX``, ``ARMAX``)."""

    models: list[str]
    baselines: list[str]
    seeds: str | None


def compare_command(
    logs: list[Path],
    validate: list[Path],
    ask: Ask,
    config: Path | None,
    out: Path | None,
    options: Mapping[str, Any],
    settings: Sequence[str],
    workers: Workers,
    publishing: bool,
    as_json: bool,
) -> None:
    """Identify every structure from the logs, rank them, say which is preferred and why."""
    if ask.seeds is not None and options.get("seed") is not None:
        raise ConfigError("--seed and --seeds: give one of them")
    prepared = prepare_models(config, options, distinct(ask.models), settings)
    seeds = parse_seeds(ask.seeds) or [prepared[0].settings.seed]
    alone = len(prepared) == 1 and not ask.baselines
    folder = out or default_folder(logs, prepared[0].model.name if alone else "comparison")
    if out is None and not alone:
        folder = folder.with_name("comparison")
    check_writable(folder)
    groups = [groups_of(p, logs, validate, together=True)[0] for p in prepared]
    _same_outputs(groups)
    note_warnings(groups)
    runs = [run for group in groups for run in group.runs(seeds)]
    found = run_all(runs, workers, as_json, lambda outcome: None)
    best = {name: outcome for (name, _), outcome in found.best().items()}
    fitted = [g for g in groups if g.prepared.model_name in best]
    if alone:
        outcome = best[fitted[0].prepared.model_name]
        _show_one(fitted[0], outcome, found, folder, publishing, as_json)
        return
    candidates = _candidates(fitted, best, ask.baselines)
    result = _compare(fitted[0], candidates)
    files = {
        group.prepared.model_name: write_parameters(
            folder / _folder_name(place, group.prepared.model_name),
            group.report(best[group.prepared.model_name]),
        )
        for place, group in enumerate(fitted, 1)
    }
    report = _document(result, groups[0], found, files)
    report["files"] = {"comparison": str(_write(folder, report))}
    if not as_json:
        _show(result, groups[0].prepared.model.output_names, found, files, folder)
    if publishing:
        from daq.report.comparison import publish_comparison  # matplotlib, as for reports

        asked = [f"--{name.lower()}" for name in ask.baselines]
        asked += ["--seeds", ask.seeds] if ask.seeds is not None else ["--seed", f"{seeds[0]}"]
        page = publish_comparison(report, groups[0], candidates, asked, folder)
        report["files"]["page"] = page
        if not as_json:
            console.print_line(f"Page: {page}")
    if as_json:
        console.print_json(report)
    elif result.preferred in files:
        console.print_next(f"rig replay LOG --parameters {files[result.preferred]}")


def _same_outputs(groups: Sequence[Group]) -> None:
    first = groups[0].prepared
    for group in groups[1:]:
        other = group.prepared
        if other.model.output_names != first.model.output_names:
            raise ConfigError(
                f"--model: {first.model_name} has the outputs "
                f"{', '.join(first.model.output_names)}, {other.model_name} "
                f"{', '.join(other.model.output_names)}; to be compared they must have the same, "
                "chosen with 'outputs' in a file given with --config"
            )


def _candidates(
    groups: Sequence[Group], best: Mapping[str, Outcome], baselines: Sequence[str]
) -> list[Candidate]:
    """Every structure fitted, with its free runs."""
    training = [log.dataset for log in groups[0].training]
    validation = [log.dataset for log in groups[0].validation]
    candidates = []
    for group in groups:
        name = group.prepared.model_name
        own = [[log.dataset for log in logs] for logs in (group.training, group.validation)]
        estimator = best[name].estimator
        assert estimator is not None
        candidates.append(Candidate.of(name, estimator, *own))
    for kind in baselines:
        try:
            selection = tuned({"ARX": ARX, "ARMAX": ARMAX}[kind](stable=True), training)
        except ModelError as error:
            console.report_warning(f"{kind} is left out: {error}")
            continue
        orders = ",".join(f"{name}={order}" for name, order in selection.best.orders.items())
        candidates.append(Candidate.of(f"{kind}:{orders}", selection.model, training, validation))
    return candidates


def _compare(group: Group, candidates: Sequence[Candidate]) -> Comparison:
    weights = group.prepared.settings.weights
    names = group.prepared.model.output_names
    try:
        return compare(
            candidates,
            [log.dataset for log in group.training],
            [log.dataset for log in group.validation],
            weights=np.array([weights.get(name, 1.0) for name in names]),
        )
    except ModelError as error:
        raise ConfigError(str(error)) from None


def _show_one(
    group: Group,
    outcome: Outcome,
    found: Campaign,
    folder: Path,
    publishing: bool,
    as_json: bool,
) -> None:
    """One structure with several seeds: the best run like any other, and the spread."""
    (spread,) = found.spread()
    result = group.result(outcome)
    report = document(result) | {"seeds": _spread_document(spread)}
    path = write_parameters(folder, report)
    report["files"] = {"parameters": str(path)}
    if not as_json:
        reporting.show(result, path)
        _show_runs(found)
    if publishing:
        publish_report(group.prepared, result, report, folder, as_json)
    if as_json:
        console.print_json(report)
    else:
        reporting.show_next(result, path)


def _document(
    result: Comparison, group: Group, found: Campaign, files: Mapping[str, Path]
) -> dict[str, Any]:
    outputs = group.prepared.model.output_names
    spreads = {spread.model: spread for spread in found.spread()}
    rows = []
    for row in result.rows:
        entry = _row_document(row, outputs)
        if row.name in spreads:
            entry["seeds"] = _spread_document(spreads[row.name])
            entry["parameters_file"] = str(files[row.name])
        rows.append(entry)
    return {
        "preferred": result.preferred,
        "verdict": result.verdict,
        "validated": result.validated,
        "training": [str(log.path) for log in group.training],
        "validation": [str(log.path) for log in group.validation],
        "structures": rows,
        "criteria": {
            "formula": _FORMULA,
            "samples": result.n_samples,
            "independent_samples": result.n_independent,
        },
        "failed": [f"{o.run.name}, seed {o.run.seed}: {o.problem}" for o in found.failed],
        "interrupted": found.interrupted,
        "software": software_versions(),
    }


def _row_document(row: Row, outputs: Sequence[str]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": row.name,
        "verdict": row.verdict,
        "free_parameters": row.n_free,
        "effective_parameters": row.n_effective,
        "training_error": row.training_error,
        "daic": row.daic,
        "dbic": row.dbic,
    }
    if not np.isnan(row.rmse).all():
        entry["outputs"] = {
            name: {
                "rmse": float(row.rmse[j]),
                "msd": float(row.msd[j]),
                "fit_percent": float(row.fit[j]),
            }
            for j, name in enumerate(outputs)
        }
    if row.ratio is not None:
        entry["squared_errors_relative"] = {
            "value": row.ratio.value,
            "interval_95": [row.ratio.low, row.ratio.high],
            "p_value": row.ratio.p_value,
        }
    return entry


def _spread_document(spread: Spread) -> dict[str, Any]:
    return {
        "runs": spread.runs,
        "failed": spread.failed,
        "best": spread.best,
        "median": spread.median,
        "worst": spread.worst,
        "within_1_percent": spread.agreeing,
    }


def _write(folder: Path, report: Mapping[str, Any]) -> Path:
    path = folder / "comparison.yaml"
    write_whole(path, yaml.safe_dump(dict(report), sort_keys=False, allow_unicode=True))
    return path


def _show(
    result: Comparison,
    outputs: Sequence[str],
    found: Campaign,
    files: Mapping[str, Path],
    folder: Path,
) -> None:
    console.print_line()
    if result.validated:
        console.print_table(
            "Validation, free run: RMSE in parts of max|y| (fit in %)",
            ["structure", *outputs, "squared errors", "95 % interval", ""],
            [_validation_row(row) for row in result.rows],
            text=[""],
        )
    console.print_table(
        "Training",
        ["structure", "free parameters", "effective", "mean RMSE", "dAIC", "dBIC"],
        [_training_row(row) for row in result.rows],
    )
    console.print_text(
        f"AIC and BIC count {result.n_samples} training samples as "
        f"{result.n_independent:.0f} independent ones."
    )
    console.print_text(result.verdict)
    _show_runs(found)
    for name, path in files.items():
        console.print_line(f"Parameters of {name}: {path}")
    console.print_line(f"Comparison: {folder / 'comparison.yaml'}")


def _show_runs(found: Campaign) -> None:
    for spread in found.spread():
        if spread.runs > 1:
            console.print_text(
                f"{spread.model}: error of {spread.runs} seeds {console.number(spread.best)} to "
                f"{console.number(spread.worst)}, {spread.agreeing} within 1 % of the best."
            )
    for problem in dict.fromkeys(f"{o.run.name}: {o.problem}" for o in found.failed):
        console.print_text(f"Failed: {problem}")
    if found.interrupted:
        console.print_line(f"Stopped by Ctrl-C after {len(found.outcomes)} runs.")


def _validation_row(row: Row) -> list[str]:
    cells = [
        f"{console.number(float(rmse), 3)} ({fit:.1f})"
        for rmse, fit in zip(row.rmse, row.fit, strict=True)
    ]
    ratio = row.ratio
    if ratio is None:
        return [row.name, *cells, "", "", row.verdict]
    interval = f"{ratio.low:.3g} .. {ratio.high:.3g}"
    return [row.name, *cells, f"x {ratio.value:.3g}", interval, row.verdict]


def _training_row(row: Row) -> list[str]:
    return [
        row.name,
        str(row.n_free),
        str(row.n_effective),
        console.number(row.training_error, 3),
        f"{row.daic:.1f}",
        f"{row.dbic:.1f}",
    ]


def _folder_name(place: int, name: str) -> str:
    """A folder for a model's results: its place, and what of its name a file system takes."""
    last = name.replace("\\", "/").rpartition("/")[2]
    return f"{place}-" + re.sub(r"[^A-Za-z0-9.=,-]+", "-", last)[:80]
