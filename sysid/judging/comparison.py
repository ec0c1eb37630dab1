"""Which model structure to believe: validation, information criteria, parsimony.

A structure is better than another when it explains records better that neither has seen, by more
than chance; among structures that are as good as the best the one with the fewest parameters is
preferred.

*Validation.* The loss of a sample is the mean over the outputs of the squared error of the free
run, each output in units of the best structure's mean squared error: outputs of any unit count
alike, and a mean loss of 1.2 means squared errors a fifth larger. The best structure is the one
with the lowest geometric mean of its outputs' errors; by the inequality of arithmetic and
geometric mean no other has a lower mean loss. ``evidence.ratio_of_means`` gives the interval of
the ratio of two structures' losses over the same samples.

*Information criteria.* Of the free run's residuals e_t on the training records, all outputs
together:

    AIC = n_e ln det S + 2 k,    BIC = n_e ln det S + k ln n_e,    S = (1/n) sum of e_t e_t'

the Gaussian likelihood but for a constant that all structures share (Akaike 1974; Schwarz 1978).
Residuals of a free run are coloured, and n of them tell less than n independent ones: n_e is
``evidence.independent_samples`` of the structure with the lowest det S, for all structures. k is
the number of parameters that the data determine: combinations that do not act on the outputs fit
nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.judging.evidence import Ratio, independent_samples, ratio_of_means
from sysid.problem.data import Dataset, output_scale
from sysid.problem.metrics import Metrics, fit_percent, mean_known, msd, rmse
from sysid.problem.model import ModelError

if TYPE_CHECKING:
    from sysid.gassi import GASSI
    from sysid.linear import ARMAX, ARX, OE

# Squared errors of at most so many times the best one's make no difference in practice.
AS_GOOD = 1.01
# A difference of BIC up to this is not worth more than a bare mention (Kass & Raftery, "Bayes
# factors", J. American Statistical Association 90, 1995).
_BIC_MARGIN = 2.0
# One above this is very strong evidence (ibidem).
_BIC_STRONG = 10.0
_UNBOUNDED = 1e150  # beyond it squares leave the floating-point range

Standing = Literal["best", "as good", "worse", "failed"]


@dataclass(frozen=True)
class Candidate:
    """A fitted structure: what it cost, and its free runs.

    n_free: numbers that were fitted, initial states of the training records among them.
    n_effective: how many of them, or of their combinations, the data determine. training,
    validation: per record the simulated outputs, (n_samples, n_outputs). n_lags: rows at a
    record's start that it takes as given.

    >>> from sysid import ARX
    >>> from sysid.examples import lag_record
    >>> candidate = Candidate.of("first order", ARX(na=1, nb=1).fit(lag_record()), [lag_record()])
    >>> candidate.n_free
    3
    """

    name: str
    n_free: int
    n_effective: int
    training: tuple[FloatArray, ...]
    validation: tuple[FloatArray, ...]
    n_lags: int = 0

    @classmethod
    def of(
        cls,
        name: str,
        estimator: GASSI | ARX | ARMAX | OE,
        training: Sequence[Dataset],
        validation: Sequence[Dataset] = (),
    ) -> Candidate:
        """The structure of an estimator that was fitted to the training records."""
        from sysid.gassi import GASSI

        trained = tuple(estimator.predict(record) for record in training)
        tested = tuple(estimator.predict(record) for record in validation)
        if not isinstance(estimator, GASSI):
            n = len(estimator.theta_)
            return cls(name, n, n, trained, tested, estimator.n_lags_)
        n = len(estimator.space_.names)
        try:
            rank = estimator.determined_rank(training)
        except ModelError:  # without intervals all count
            rank = n
        return cls(name, n, rank, trained, tested)


@dataclass(frozen=True)
class Row:
    """A structure in the comparison; arrays are (n_outputs,).

    training_error: mean over outputs of the RMSE in parts of max|y|. rmse, msd, fit: on the
    validation records, rmse and msd in parts of max|y|; NaN without any. rmse_absolute,
    training_rmse_absolute: RMSE in the outputs' units. daic, dbic: above the
    lowest of all structures. ratio: squared errors on validation in parts of the best
    structure's; None for the best itself, without validation, and for a structure whose free run
    left the floating-point range.
    """

    name: str
    n_free: int
    n_effective: int
    training_error: float
    rmse: FloatArray
    msd: FloatArray
    fit: FloatArray
    rmse_absolute: FloatArray
    training_rmse_absolute: FloatArray
    daic: float
    dbic: float
    ratio: Ratio | None
    verdict: Standing

    @property
    def good(self) -> bool:
        """Whether no structure is better by more than chance."""
        return self.verdict in ("best", "as good")


@dataclass(frozen=True)
class Comparison:
    """Structures, the best first, and which of them is preferred.

    validated: whether there were validation records; else BIC ranks. n_samples: training rows
    behind the information criteria; n_independent: what they are worth.

    >>> run = np.array([[0.0], [1.0], [0.0], [-1.0]])
    >>> record = Dataset(np.zeros(4), run, dt=0.1)
    >>> close, far = (Candidate(f"{e} off", 1, 1, (run + e,), (run + e,)) for e in (0.1, 0.2))
    >>> compare([far, close], [record], [record]).rows[0].name
    '0.1 off'
    """

    rows: tuple[Row, ...]
    preferred: str
    validated: bool
    n_samples: int
    n_independent: float

    def row(self, name: str) -> Row:
        """The structure of a name."""
        return next(row for row in self.rows if row.name == name)

    @property
    def verdict(self) -> str:
        """The comparison in sentences."""
        best, *rest = self.rows
        ranking = f"{best.name} explains the validation data best."
        if not self.validated:
            ranking = (
                "Without validation data this ranks by BIC on the training data, which favours "
                f"{best.name}; validation data would decide better."
            )
        sentences = [ranking, *(_against(row, best.name) for row in rest), *self._preference()]
        return " ".join(sentences)

    def _preference(self) -> list[str]:
        """Sentences on which of the equally good structures is preferred, and why."""
        chosen = self.row(self.preferred)
        equals = [row for row in self.rows if row.good]
        sentences = [
            f"The BIC of {row.name} on the training data, {row.dbic - chosen.dbic:.3g} above that "
            f"of {chosen.name}, is strong evidence against it."
            for row in equals
            if row.dbic - chosen.dbic > _BIC_STRONG and row.n_effective <= chosen.n_effective
        ]
        if chosen is not self.rows[0] and not sentences:
            return [
                f"{chosen.name} is preferred: it has {chosen.n_effective} effective parameters, "
                f"{self.rows[0].name} has {self.rows[0].n_effective}."
            ]
        return [*sentences, f"{chosen.name} is preferred."] if len(equals) > 1 else sentences


def compare(
    candidates: Sequence[Candidate],
    training: Sequence[Dataset],
    validation: Sequence[Dataset] = (),
    *,
    weights: FloatArray | None = None,
) -> Comparison:
    """Rank structures on validation records, without any by BIC on the training records.

    training, validation: the records of the candidates' free runs, in their order. weights:
    (n_outputs,), relative importance, default equal. Raises ModelError for names that repeat, or
    when no structure has a free run that stays finite.

    >>> from sysid import ARX
    >>> from sysid.examples import lag_record
    >>> training, validation = [lag_record()], [lag_record(seed=1)]
    >>> first, second = (ARX(na=na, nb=1).fit(training) for na in (1, 2))
    >>> candidates = [
    ...     Candidate.of("first order", first, training, validation),
    ...     Candidate.of("second order", second, training, validation),
    ... ]
    >>> compare(candidates, training, validation).preferred
    'first order'
    """
    names = [candidate.name for candidate in candidates]
    if len(set(names)) < len(names) or not names:
        raise ModelError("a comparison needs structures of different names")
    # All on the same rows, whatever past each of them starts from.
    lag = max(candidate.n_lags for candidate in candidates)
    q = training[0].outputs.shape[1]
    importance = np.ones(q) if weights is None else np.asarray(weights, dtype=np.float64)
    importance = importance / importance.sum()
    trained = [_FreeRuns(training, candidate.training, lag) for candidate in candidates]
    aic, bic, n, worth = _criteria(trained, [candidate.n_effective for candidate in candidates])
    tested = [_FreeRuns(validation, c.validation, lag) for c in candidates if validation]
    score = np.array([runs.score(importance) for runs in tested]) if tested else bic
    best = int(np.argmin(score))
    ratios = _ratios(tested, best, importance) if tested else [None] * len(names)
    if np.isposinf(score[best]):
        if n == 0 and any(runs.finite for runs in trained):
            raise ModelError(
                "no sample of the training records has all outputs measured, by which structures "
                "are ranked without a validation; give a log to validate with"
            )
        raise ModelError("no structure has a free run that stays finite")
    with np.errstate(invalid="ignore"):  # all may be infinite
        daic, dbic = (aic - aic.min()).tolist(), (bic - bic.min()).tolist()
    unmeasured = Metrics(*[np.full(q, np.nan)] * 4)
    metrics = [runs.metrics for runs in tested] or [unmeasured] * len(names)
    rows = []
    for i in np.argsort(score, kind="stable").tolist():
        structure, quality = candidates[i], metrics[i]
        standing = _standing(i == best, score[i], ratios[i], dbic[i])
        row = Row(
            structure.name, structure.n_free, structure.n_effective,
            trained[i].mean_rmse(importance), quality.rmse, quality.msd, quality.fit,
            quality.rmse_absolute, trained[i].rmse_absolute,
            daic[i], dbic[i], ratios[i], standing,
        )  # fmt: skip
        rows.append(row)
    least = min(row.dbic for row in rows if row.good)
    backed = [row for row in rows if row.good and not row.dbic - least > _BIC_STRONG]
    preferred = min(backed, key=lambda row: row.n_effective)
    return Comparison(tuple(rows), preferred.name, bool(validation), n, worth)


class _FreeRuns:
    """Free runs of a structure on some records, without the first ``lag`` rows of each.

    measured, simulated: per record (n_rows, n_outputs). scale: max|y| over all, (n_outputs,).
    """

    def __init__(self, records: Sequence[Dataset], runs: Sequence[FloatArray], lag: int) -> None:
        self.measured = [record.outputs[lag:] for record in records]
        self.simulated = [np.ascontiguousarray(run[lag:]) for run in runs]
        self.scale = output_scale(list(records))[0]

    @cached_property
    def finite(self) -> bool:
        """Whether all runs stay within the floating-point range."""
        with np.errstate(invalid="ignore"):
            return all(bool(np.all(np.abs(run) < _UNBOUNDED)) for run in self.simulated)

    @cached_property
    def seen(self) -> BoolArray:
        """Outputs that have a measured sample, (n_outputs,)."""
        seen: BoolArray = np.any(np.isfinite(np.concatenate(self.measured)), axis=0)
        return seen

    @property
    def residuals(self) -> list[FloatArray]:
        """Simulated minus measured in parts of max|y|, per record; NaN where a sample was lost."""
        pairs = zip(self.measured, self.simulated, strict=True)
        return [(simulated - measured) / self.scale for measured, simulated in pairs]

    @cached_property
    def metrics(self) -> Metrics:
        """RMSE and MSD over all records, mean fit %; infinitely bad where a run failed."""
        if not self.finite:
            rmses, msds, fits = np.outer([np.inf, np.nan, -np.inf], np.ones(len(self.scale)))
            return Metrics(rmses, msds, fits, self.scale)
        measured, simulated = np.concatenate(self.measured), np.concatenate(self.simulated)
        fit = mean_known(list(map(fit_percent, self.measured, self.simulated)), 0)
        rmses, msds = (metric(measured, simulated, self.scale) for metric in (rmse, msd))
        return Metrics(rmses, msds, fit, self.scale)

    @property
    def rmse_absolute(self) -> FloatArray:
        """RMSE in the outputs' units, (n_outputs,); NaN of those without a measured sample."""
        absolute: FloatArray = np.where(self.seen, self.metrics.rmse_absolute, np.nan)
        return absolute

    def mean_rmse(self, importance: FloatArray) -> float:
        """Mean over the outputs that were measured."""
        share = np.where(self.seen, importance, 0.0)
        return float(np.where(self.seen, self.metrics.rmse, 0.0) @ share / share.sum())

    def score(self, importance: FloatArray) -> float:
        """Logarithm of the geometric mean of the RMSEs of the outputs that were measured."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.metrics.rmse)
        counted = self.seen & (importance > 0.0)
        return float(logs[counted] @ importance[counted] / importance[counted].sum())


def _criteria(
    trained: Sequence[_FreeRuns], n_effective: Sequence[int]
) -> tuple[FloatArray, FloatArray, int, float]:
    """AIC and BIC, (n_candidates,), the rows behind them and how many independent these are."""
    log_det = np.full(len(trained), np.inf)
    residuals: list[list[FloatArray]] = []
    for i, runs in enumerate(trained):
        # Rows in which all outputs were measured.
        parts = [e[np.isfinite(e).all(axis=1)] for e in runs.residuals] if runs.finite else []
        residuals.append([part for part in parts if len(part)])
        if residuals[i]:
            joined = np.concatenate(residuals[i])
            log_det[i] = np.linalg.slogdet(joined.T @ joined / len(joined))[1]
    if not any(residuals):
        return log_det, log_det, 0, 0.0
    best = int(np.argmin(log_det))
    n, worth = sum(map(len, residuals[best])), independent_samples(residuals[best])
    k = np.asarray(n_effective, dtype=np.float64)
    return worth * log_det + 2.0 * k, worth * log_det + np.log(worth) * k, n, worth


def _ratios(tested: Sequence[_FreeRuns], best: int, importance: FloatArray) -> list[Ratio | None]:
    """Squared errors of each structure in parts of the best one's."""
    reference = tested[best]
    if not reference.finite:
        return [None] * len(tested)
    unit = np.maximum(reference.metrics.rmse**2, np.finfo(float).tiny)
    counts = np.isfinite(np.concatenate(reference.measured)).sum(axis=0)
    rows = sum(map(len, reference.measured))
    # An output that was not measured everywhere counts by its mean all the same.
    share = np.where(reference.seen, importance * rows / np.maximum(counts, 1) / unit, 0.0)
    share /= importance[reference.seen].sum()

    def losses(runs: _FreeRuns) -> list[FloatArray]:
        return [np.where(np.isfinite(e), e, 0.0) ** 2 @ share for e in runs.residuals]

    baseline = losses(reference)
    return [
        ratio_of_means(losses(runs), baseline) if runs.finite and runs is not reference else None
        for runs in tested
    ]


def _standing(best: bool, score: float, ratio: Ratio | None, dbic: float) -> Standing:
    if np.isposinf(score):
        return "failed"
    if best:
        return "best"
    good = ratio.low <= AS_GOOD if ratio is not None else dbic <= _BIC_MARGIN
    return "as good" if good else "worse"


def _against(row: Row, best: str) -> str:
    """A structure beside the best one, in a sentence; without validation by BIC."""
    if row.verdict == "failed":
        return f"{row.name} failed: its free run grows out of bounds."
    if row.ratio is None:
        return f"{row.name} is {above(row.dbic)} above it: {row.verdict}."
    value, low, high = (times(x) for x in (row.ratio.value, row.ratio.low, row.ratio.high))
    size = f"{row.name} has squared errors {value} times those of {best} (95 %: {low} to {high})"
    if row.verdict == "worse":
        p = "p < 0.001" if row.ratio.p_value < 1e-3 else f"p = {row.ratio.p_value:.2g}"
        return f"{size}: worse, by more than chance ({p})."
    return f"{size}: as good, as far as these data tell."


def times(ratio: float) -> str:
    """A ratio of squared errors, as finely as it tells structures apart.

    >>> times(1.0041), times(1.292), times(31.21)
    ('1.004', '1.29', '31.2')
    """
    if abs(ratio) >= 10.0:
        return f"{ratio:.3g}"
    return f"{ratio:.3f}" if abs(ratio - 1.0) < 0.1 else f"{ratio:.2f}"


def above(criterion: float) -> str:
    """By how much a criterion is above the lowest, as finely as it matters.

    >>> above(7.73), above(2903.2)
    ('7.7', '2903')
    """
    return f"{criterion:.1f}" if abs(criterion) < 99.95 else f"{criterion:.0f}"
