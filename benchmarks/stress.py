"""Is the verdict fooled? Faults in data and structure that must not be called good, and none.

python -m benchmarks.stress [--json] [--seeds 20] [--correct 100] [--only NAME]

A direct-current motor, simulated here by a Runge-Kutta scheme of its own, is identified from 1.5 s
under random levels and judged on as much again. A faulty case is passed where the verdict is not
good, or names what is wrong, or where no interval excludes the truth that holds it without the
fault; a correct one where the verdict is good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from benchmarks._common import arguments, report
from benchmarks._stress_cases import Case, cases
from sysid import Dataset
from sysid.gassi import GASSI
from sysid.judging.assessment import Verdict
from sysid.judging.examination import verdict_of


@dataclass(frozen=True)
class Outcome:
    """What became of a case: its verdict, and the quantities that its fault has moved.

    Their intervals exclude the truth, and hold it in the same data without the fault.
    """

    case: Case
    verdict: Verdict
    moved: tuple[str, ...]

    @property
    def named(self) -> bool:
        """Whether the fault is named."""
        sentences = (*self.verdict.reasons, *self.verdict.notes)
        return any(word in sentence for word in self.case.words for sentence in sentences)

    @property
    def passed(self) -> bool:
        """Whether the verdict was not fooled."""
        good = self.verdict.trust == "good"
        return good if self.case.kind == "correct" else not good or self.named or not self.moved


def tried(case: Case, seed: int) -> Outcome:
    """Fit and judge a case."""
    training, validation = case.records(seed)
    estimator = fitted(case, training, seed)
    moved = wrong(case, estimator, training, seed)
    if moved and case.kind != "correct":
        sound = replace(case, plant=case.sound, fault=lambda u, y, rng: (u, y))
        records = sound.records(seed)[0]
        moved -= wrong(sound, fitted(sound, records, seed), records, seed)
    return Outcome(case, verdict_of(estimator, training, [validation]), tuple(sorted(moved)))


def fitted(case: Case, training: list[Dataset], seed: int) -> GASSI:
    """The case's model, identified."""
    return GASSI(case.model, population=60, generations=12, random_state=seed).fit(training)


def wrong(case: Case, estimator: GASSI, training: list[Dataset], seed: int) -> set[str]:
    """Determined quantities whose intervals exclude the truth."""
    starts = estimator.space_.names[len(estimator.space_.index) :]  # of which nothing is asked
    determined = estimator.uncertainty(training).determined()
    estimates = [estimate for estimate in determined if estimate.name not in starts]
    return {estimate.name for estimate in estimates if estimate.excludes(case.truth(seed))}


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=20, help="of each faulty case")
    parser.add_argument("--correct", type=int, default=100, help="seeds of each correct case")
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    options = parser.parse_args()
    rows = []
    for case in cases():
        if options.only in case.name or options.only == case.kind:
            count = options.correct if case.kind == "correct" else options.seeds
            outcomes = [tried(case, seed) for seed in range(count)]
            rows.append(_row(case, outcomes))
    report({"cases": rows}, options.json, show)


def _row(case: Case, outcomes: list[Outcome]) -> dict[str, Any]:
    last = outcomes[-1].verdict
    return {
        "case": case.name,
        "kind": case.kind,
        "seeds": len(outcomes),
        "passed": sum(outcome.passed for outcome in outcomes),
        "good": sum(outcome.verdict.trust == "good" for outcome in outcomes),
        "moved": sum(bool(outcome.moved) for outcome in outcomes),
        "says": [*last.predicted.reasons, *last.parameters.reasons],
    }


def show(figures: dict[str, Any]) -> None:
    head = f"{'case':32}{'kind':12}{'seeds':>6}{'passed':>8}{'good':>6}{'moved':>7}"
    print(f"\n{head}")
    for row in figures["cases"]:
        counts = f"{row['seeds']:6}{row['passed']:8}{row['good']:6}{row['moved']:7}"
        print(f"{row['case']:32}{row['kind']:12}{counts}  {row['says'][-1][:90]}")
    kinds = dict.fromkeys(row["kind"] for row in figures["cases"])
    for kind in kinds:
        rows = [row for row in figures["cases"] if row["kind"] == kind]
        passed, seeds = (sum(row[key] for row in rows) for key in ("passed", "seeds"))
        print(f"{kind}: {passed} of {seeds} passed")


if __name__ == "__main__":
    main()
