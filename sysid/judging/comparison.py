"""Which model structure to believe: validation, information criteria, parsimony.

A structure is better than another when it explains records better that neither has seen, by more
than chance; among structures that are as good as the best the one with the fewest parameters is
preferred.

*Validation.* The loss of a sample is the mean over the outputs of the squared error of the free
run, each output in units of the best structure's mean squared error: outputs of any unit count
alike, and a mean loss of 1.2 means squared errors a fifth larger. The best structure is the one
with the lowest geometric mean of its outputs' errors; by the inequality of arithmetic and
geometric mean no other has a lower mean loss. How surely the losses of two structures differ over
the same samples says ``evidence.ratio_of_means``.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from sysid.arrays import BoolArray, FloatArray
from sysid.judging.evidence import Ratio, independent_samples, ratio_of_means
from sysid.problem.data import Dataset, output_scale
from sysid.problem.metrics import fit_percent, msd, rmse
from sysid.problem.model import ModelError

if TYPE_CHECKING:
    from sysid.gassi import GASSI
    from sysid.linear import ARMAX, ARX

# Squared errors larger by no more than this share make no difference in practice.
_MARGIN = 0.01
# A difference of BIC up to this is not worth more than a bare mention (Kass & Raftery, "Bayes
# factors", J. American Statistical Association 90, 1995).
_BIC_MARGIN = 2.0
# One above this is very strong evidence (ibidem).
_BIC_STRONG = 10.0
_UNBOUNDED = 1e150  # beyond it squares leave the floating-point range

Verdict = Literal["best", "as good", "worse", "failed"]


@dataclass(frozen=True)
class Candidate:
    """A fitted structure: what it cost, and its free runs.

    n_free: numbers that were fitted, initial states of the training records among them.
    n_effective: how many of them, or of their combinations, the data determine. training,
    validation: per record the simulated outputs, (n_samples, n_outputs). n_lags: rows at a
    record's start that it takes as given.
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
        estimator: GASSI | ARX | ARMAX,
        training: Sequence[Dataset],
        validation: Sequence[Dataset] = (),
    ) -> Candidate:
        """Of an estimator that was fitted to the training records."""
        from sysid.gassi import GASSI

        trained = tuple(estimator.predict(record) for record in training)
        tested = tuple(estimator.predict(record) for record in validation)
        if not isinstance(estimator, GASSI):
            n = len(estimator.theta_)
            return cls(name, n, n, trained, tested, estimator.n_lags_)
        n = len(estimator.space_.names)
        return cls(name, n, _rank(estimator, training), trained, tested)


@dataclass(frozen=True)
class Row:
    """One structure in the comparison; arrays are (n_outputs,).

    training_error: mean over outputs of the RMSE in parts of max|y|. rmse, msd, fit: on the
    validation records, rmse and msd in parts of max|y|; NaN without any. daic, dbic: above the
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
    daic: float
    dbic: float
    ratio: Ratio | None
    verdict: Verdict


@dataclass(frozen=True)
class Comparison:
    """Structures, the best first, and which of them is preferred.

    validated: whether there were validation records; else BIC ranks. n_samples: training rows
    behind the information criteria; n_independent: what they are worth.
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
        """What the comparison says, in sentences."""
        best = self.rows[0]
        if self.validated:
            said = [f"{best.name} explains the validation data best."]
            said += [_against_validation(row, best.name) for row in self.rows[1:]]
        else:
            said = [
                "Without validation data this ranks by BIC on the training data, which favours "
                f"{best.name}; validation data would decide better."
            ]
            said += [_against_training(row) for row in self.rows[1:]]
        return " ".join([*said, *self._preference()])

    def _preference(self) -> list[str]:
        """Which of those that are as good is preferred, and why."""
        chosen = self.row(self.preferred)
        equals = [row for row in self.rows if row.verdict in ("best", "as good")]
        said = []
        for row in equals:
            if row.dbic - chosen.dbic > _BIC_STRONG and row.n_effective <= chosen.n_effective:
                said.append(
                    f"The BIC of {row.name} on the training data, {row.dbic - chosen.dbic:.3g} "
                    f"above that of {chosen.name}, is strong evidence against it."
                )
        if chosen is not self.rows[0] and not said:
            said.append(
                f"{chosen.name} is preferred: it has {chosen.n_effective} effective parameters, "
                f"{self.rows[0].name} has {self.rows[0].n_effective}."
            )
        elif len(equals) > 1:
            said.append(f"{chosen.name} is preferred.")
        return said


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
    """
    names = [candidate.name for candidate in candidates]
    if len(set(names)) < len(names) or not names:
        raise ModelError("a comparison needs structures of different names")
    # All on the same rows, whatever past each of them starts from.
    lag = max(candidate.n_lags for candidate in candidates)
    q = training[0].outputs.shape[1]
    importance = np.ones(q) if weights is None else np.asarray(weights, dtype=np.float64)
    importance = importance / importance.sum()
    trained = _Errors.of(training, [c.training for c in candidates], lag)
    tested = _Errors.of(validation, [c.validation for c in candidates], lag)
    criteria = _criteria(trained, [c.n_effective for c in candidates])
    if validation:
        score = np.array([tested.score(i, importance) for i in range(len(names))])
        ratios = _ratios(tested, int(np.argmin(score)), importance)
    else:
        score, ratios = criteria.bic, [None] * len(names)
    order = [int(i) for i in np.argsort(score, kind="stable")]
    if np.isposinf(score[order[0]]):
        raise ModelError("no structure has a free run that stays finite")
    daic, dbic = _above_lowest(criteria.aic), _above_lowest(criteria.bic)
    verdicts = [
        _verdict(i == order[0], float(score[i]), ratios[i], float(dbic[i]))
        for i in range(len(names))
    ]
    good = [i for i in order if verdicts[i] in ("best", "as good")]
    least = min(dbic[i] for i in good)
    backed = [i for i in good if not dbic[i] - least > _BIC_STRONG]
    preferred = min(backed, key=lambda i: (candidates[i].n_effective, order.index(i)))
    rows = [
        Row(
            candidates[i].name,
            candidates[i].n_free,
            candidates[i].n_effective,
            trained.mean_rmse(i, importance),
            tested.rmse(i) if validation else np.full(q, np.nan),
            tested.msd(i) if validation else np.full(q, np.nan),
            tested.fit(i) if validation else np.full(q, np.nan),
            float(daic[i]),
            float(dbic[i]),
            ratios[i],
            verdicts[i],
        )
        for i in order
    ]
    return Comparison(
        tuple(rows), names[preferred], bool(validation), criteria.n, criteria.n_independent
    )


@dataclass(frozen=True)
class _Errors:
    """Errors of all structures on the same rows of some records.

    measured: per record (n_rows, n_outputs); simulated: per record (n_candidates, n_rows,
    n_outputs). scale: (n_outputs,), max|y| over all records. finite: per candidate.
    """

    measured: list[FloatArray]
    simulated: list[FloatArray]
    scale: FloatArray
    finite: list[bool]

    @classmethod
    def of(
        cls, records: Sequence[Dataset], runs: Sequence[Sequence[FloatArray]], lag: int
    ) -> _Errors:
        """Without the first ``lag`` rows of each record."""
        scale = output_scale(list(records))[0] if records else np.ones(0)
        measured = [record.outputs[lag:] for record in records]
        simulated = [np.stack([run[k][lag:] for run in runs]) for k in range(len(records))]
        with np.errstate(invalid="ignore"):
            finite = [
                all(bool(np.all(np.abs(run[i]) < _UNBOUNDED)) for run in simulated)
                for i in range(len(runs))
            ]
        return cls(measured, simulated, scale, finite)

    @property
    def seen(self) -> BoolArray:
        """Outputs that have a measured sample, (n_outputs,)."""
        found: BoolArray = np.any(np.isfinite(np.concatenate(self.measured)), axis=0)
        return found

    def residuals(self, i: int) -> list[FloatArray]:
        """Simulated minus measured in parts of max|y|, per record; NaN where a sample was lost."""
        pairs = zip(self.measured, self.simulated, strict=True)
        return [(simulated[i] - measured) / self.scale for measured, simulated in pairs]

    def rmse(self, i: int) -> FloatArray:
        """Over all records, (n_outputs,); infinite for a free run that failed."""
        return self._over_all(rmse, i, np.inf)

    def msd(self, i: int) -> FloatArray:
        """Over all records, (n_outputs,)."""
        return self._over_all(msd, i, np.nan)

    def fit(self, i: int) -> FloatArray:
        """Fit %, mean over the records, (n_outputs,)."""
        if not self.finite[i]:
            return np.full(len(self.scale), -np.inf)
        pairs = zip(self.measured, self.simulated, strict=True)
        fits = np.array([fit_percent(y, simulated[i]) for y, simulated in pairs])
        known = ~np.isnan(fits)
        with np.errstate(invalid="ignore"):
            mean: FloatArray = np.where(known, fits, 0.0).sum(axis=0) / known.sum(axis=0)
        return mean

    def mean_rmse(self, i: int, importance: FloatArray) -> float:
        """Mean over the outputs that were measured."""
        share = np.where(self.seen, importance, 0.0)
        return float(np.where(self.seen, self.rmse(i), 0.0) @ share / share.sum())

    def score(self, i: int, importance: FloatArray) -> float:
        """Logarithm of the geometric mean of the RMSEs of the outputs that were measured."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.rmse(i))
        counted = self.seen & (importance > 0.0)
        return float(logs[counted] @ importance[counted] / importance[counted].sum())

    def _over_all(self, metric: Callable[..., FloatArray], i: int, otherwise: float) -> FloatArray:
        if not self.finite[i]:
            return np.full(len(self.scale), otherwise)
        simulated = np.concatenate([run[i] for run in self.simulated])
        return metric(np.concatenate(self.measured), simulated, self.scale)


@dataclass(frozen=True)
class _Criteria:
    """aic, bic: (n_candidates,), infinite for a free run that failed; n rows are worth so many."""

    aic: FloatArray
    bic: FloatArray
    n: int
    n_independent: float


def _criteria(errors: _Errors, n_effective: Sequence[int]) -> _Criteria:
    log_det = np.full(len(n_effective), np.inf)
    residuals: list[list[FloatArray]] = []
    for i, finite in enumerate(errors.finite):
        # Rows in which every output was measured.
        own = [e[np.isfinite(e).all(axis=1)] for e in errors.residuals(i)] if finite else []
        residuals.append([part for part in own if len(part)])
        if residuals[i]:
            every = np.concatenate(residuals[i])
            log_det[i] = np.linalg.slogdet(every.T @ every / len(every))[1]
    if not any(residuals):
        return _Criteria(log_det, log_det, 0, 0.0)
    best = int(np.argmin(log_det))
    n, worth = sum(map(len, residuals[best])), independent_samples(residuals[best])
    k = np.asarray(n_effective, dtype=np.float64)
    return _Criteria(worth * log_det + 2.0 * k, worth * log_det + np.log(worth) * k, n, worth)


def _ratios(errors: _Errors, best: int, importance: FloatArray) -> list[Ratio | None]:
    """Squared errors of each structure in parts of the best one's."""
    if not errors.finite[best]:
        return [None] * len(errors.finite)
    unit = np.maximum(errors.rmse(best) ** 2, np.finfo(float).tiny)
    counts = np.isfinite(np.concatenate(errors.measured)).sum(axis=0)
    rows = sum(map(len, errors.measured))
    # An output that was not measured everywhere counts by its mean all the same.
    share = np.where(errors.seen, importance * rows / np.maximum(counts, 1) / unit, 0.0)
    share /= importance[errors.seen].sum()

    def losses(i: int) -> list[FloatArray]:
        return [np.where(np.isfinite(e), e, 0.0) ** 2 @ share for e in errors.residuals(i)]

    reference = losses(best)
    return [
        ratio_of_means(losses(i), reference) if finite and i != best else None
        for i, finite in enumerate(errors.finite)
    ]


def _above_lowest(values: FloatArray) -> FloatArray:
    """Differences from the lowest; NaN when all are infinite."""
    with np.errstate(invalid="ignore"):
        above: FloatArray = values - values.min()
    return above


def _verdict(best: bool, score: float, ratio: Ratio | None, dbic: float) -> Verdict:
    if np.isposinf(score):
        return "failed"
    if best:
        return "best"
    good = ratio.low <= 1.0 + _MARGIN if ratio is not None else dbic <= _BIC_MARGIN
    return "as good" if good else "worse"


def _rank(estimator: GASSI, training: Sequence[Dataset]) -> int:
    """Directions of the parameters that the data determine; all where that is not known."""
    try:
        return estimator.uncertainty(training).rank
    except ModelError:
        return len(estimator.space_.names)


def _against_validation(row: Row, best: str) -> str:
    if row.ratio is None:
        return f"{row.name} failed: its free run grows out of bounds."
    value, low, high = (_times(x) for x in (row.ratio.value, row.ratio.low, row.ratio.high))
    size = f"{row.name} has squared errors {value} times those of {best} (95 %: {low} to {high})"
    if row.verdict == "worse":
        p = row.ratio.p_value
        return (
            f"{size}: worse, by more than chance ({'p < 0.001' if p < 1e-3 else f'p = {p:.2g}'})."
        )
    return f"{size}: as good, as far as these data tell."


def _against_training(row: Row) -> str:
    if row.verdict == "failed":
        return f"{row.name} failed: its free run grows out of bounds."
    meaning = "as good" if row.verdict == "as good" else "worse"
    return f"{row.name} is {row.dbic:.3g} above it: {meaning}."


def _times(ratio: float) -> str:
    return f"{ratio:.3g}" if abs(ratio) >= 10.0 else f"{ratio:.3f}"
