"""What ``rig identify`` says of several structures or seeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.cli import terminal
from daq.cli.identification import show_identification

if TYPE_CHECKING:
    from daq.identification.comparison import ComparisonResult, SeedsResult
    from sysid import Campaign
    from sysid.judging.comparison import Row


def show_comparison(
    result: ComparisonResult | SeedsResult, report: bool, json: bool
) -> dict[str, Any]:
    """Print a comparison and write its page; the document for machines."""
    from daq.identification.comparison import ComparisonResult

    if not isinstance(result, ComparisonResult):
        return show_identification(result.best, report, json, _runs_lines(result.campaign))
    files: dict[str, Any] = {"comparison": str(result.file)}
    if not json:
        _show(result)
    if report:
        from daq.report.comparison import publish_comparison  # matplotlib, as for reports

        files["page"] = publish_comparison(result)
        if not json:
            print(f"Page: {files['page']}")
    preferred = result.files.get(result.comparison.preferred)
    if not json and preferred is not None:
        terminal.print_next(f"rig replay LOG --parameters {preferred}")
    return {**result.document, "files": files}


def _show(result: ComparisonResult) -> None:
    comparison = result.comparison
    print()
    if comparison.validated:
        terminal.print_table(
            "Validation, free run: RMSE in parts of max|y| (fit in %)",
            ["structure", *result.outputs, "squared errors", "95 % interval", ""],
            [_validation_row(row) for row in comparison.rows],
            text=[""],
        )
    terminal.print_table(
        "Training",
        ["structure", "free parameters", "effective", "mean RMSE", "dAIC", "dBIC"],
        [_training_row(row) for row in comparison.rows],
    )
    terminal.print_text(
        f"AIC and BIC count {comparison.n_samples} training samples as "
        f"{comparison.n_independent:.0f} independent ones."
    )
    terminal.print_text(comparison.verdict)
    for line in _runs_lines(result.campaign):
        terminal.print_text(line)
    for name, path in result.files.items():
        print(f"Parameters of {name}: {path}")
    print(f"Comparison: {result.file}")


def _runs_lines(campaign: Campaign) -> list[str]:
    """Spread over seeds, what failed, and whether Ctrl-C ended it."""
    number = terminal.number
    lines = [
        f"{spread.model}: error of {spread.runs} seeds {number(spread.best)} to "
        f"{number(spread.worst)}, {spread.agreeing} within 1 % of the best."
        for spread in campaign.spread()
        if spread.runs > 1
    ]
    problems = dict.fromkeys(f"{o.run.name}: {o.problem}" for o in campaign.failed)
    lines += [f"Failed: {problem}" for problem in problems]
    if campaign.interrupted:
        lines.append(f"Stopped by Ctrl-C after {len(campaign.outcomes)} runs.")
    return lines


def _validation_row(row: Row) -> list[str]:
    cells = [
        f"{terminal.number(float(rmse), 3)} ({fit:.1f})"
        for rmse, fit in zip(row.rmse, row.fit, strict=True)
    ]
    ratio = row.ratio
    if ratio is None:
        return [row.name, *cells, "", "", row.verdict]
    interval = f"{ratio.low:.3g} .. {ratio.high:.3g}"
    return [row.name, *cells, f"x {ratio.value:.3g}", interval, row.verdict]


def _training_row(row: Row) -> list[str]:
    error = terminal.number(row.training_error, 3)
    counts = [str(row.n_free), str(row.n_effective)]
    return [row.name, *counts, error, f"{row.daic:.1f}", f"{row.dbic:.1f}"]
