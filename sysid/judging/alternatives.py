"""The model with what the residuals ask for, fitted as well, and whether it is better."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid.arrays import FloatArray
from sysid.judging.comparison import Candidate, Comparison, compare
from sysid.judging.findings import Finding, description, moves_of
from sysid.judging.suspects import input_noise, variants_of
from sysid.problem.data import Dataset
from sysid.problem.earlier_minima import EarlierMinima
from sysid.problem.metrics import fit_percent, mean_known
from sysid.problem.model import ModelError, ProcessModel
from sysid.problem.terms import AddedTerm, with_terms
from sysid.uncertainty import Estimate, Uncertainty

if TYPE_CHECKING:
    from sysid.gassi import GASSI

# A difference of BIC above this is very strong evidence (Kass & Raftery, "Bayes factors",
# J. American Statistical Association 90, 1995).
_STRONG = 10.0
_MOST = 0.5  # of the residuals' squares
_SEARCHED = 0.25  # of a search's simulations, which a variant is given


@dataclass(frozen=True)
class Alternative:
    """A variant, or the model with a term added, that was fitted as well.

    name: the option that makes a variant; of a term what it is, in words. better: whether it
    explains training by more than its further parameters would by chance, and validation no worse.
    estimator: fitted with it. terms: those added, none of a variant. fits: by output, fit [%] of
    the model and of the variant, on validation where there is any. values: quantities that the
    model determines and the variant has elsewhere: value of the model, of the variant, unit; the
    farthest first.
    """

    name: str
    better: bool
    fits: dict[str, tuple[float, float]]
    values: dict[str, tuple[float, float, str]]
    comparison: Comparison
    estimator: GASSI = field(repr=False)
    terms: tuple[AddedTerm, ...] = ()


def best_alternative(
    findings: Sequence[Finding],
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
    validation: Sequence[Dataset] = (),
) -> Alternative | None:
    """The surest variant among findings, fitted with the settings of an estimator.

    Or a simpler one that it contains, where that has the lower BIC: a function of speed and angle
    explains what one of speed alone does. Without a variant, the model with the surest function
    that moves its parameters, of the shape by which a fit explains most. None where there is
    neither, or none of its simulations succeeds.
    """
    if estimator.model is None:
        return None
    suspected = _suspected(findings, estimator.model)
    fitted = {name: _fitted(estimator, s.model, training) for name, s in suspected.items()}
    estimators = {name: e for name, e in fitted.items() if e is not None}
    if not estimators:
        return None
    pairs = [(_MODEL, estimator), *estimators.items()]
    candidates = {name: Candidate.of(name, e, training, validation) for name, e in pairs}
    comparison = compare(list(candidates.values()), training, validation)
    rows = {row.name: row for row in comparison.rows}
    name = min(estimators, key=lambda n: (not rows[n].good, rows[n].dbic))
    better = rows[_MODEL].dbic - rows[name].dbic > _STRONG and rows[name].good
    pair = [candidates[_MODEL], candidates[name]]
    runs = [c.validation if validation else c.training for c in pair]
    shares = [fits(validation or training, run) for run in runs]
    names = estimator.model.output_names
    return Alternative(
        name,
        better,
        {n: (float(a), float(b)) for n, a, b in zip(names, *shares, strict=True)},
        _moved(uncertainty, estimators[name].parameters_),
        comparison,
        estimators[name],
        suspected[name].terms,
    )


def _fitted(estimator: GASSI, model: ProcessModel, training: Sequence[Dataset]) -> GASSI | None:
    """A model fitted with the settings of an estimator; None where no simulation succeeds.

    It begins where the estimator's ended as well, so that a part of the simulations will do.
    """
    from sysid.gassi import GASSI

    settings = {**estimator.get_params(deep=False), "model": model}
    settings["generations"] = math.ceil(_SEARCHED * estimator.generations)
    earlier = EarlierMinima([estimator.parameters_])
    try:
        return GASSI(**settings).fit(list(training), earlier=earlier)
    except ModelError:
        return None


def moved_by_noise(
    finding: Finding,
    estimator: GASSI,
    uncertainty: Uncertainty,
    training: Sequence[Dataset],
) -> Finding:
    """A finding of an input's noise, with what a fit that takes it out moves and widens.

    A step from the minimum does not tell: what of an input is likely to be noise stands for its
    fast changes as well, and may seem larger than its samples show. And slow noise far below an
    output's own is not seen in the residuals' colour, but in what is estimated. Without moves where
    the fit fails.
    """
    from sysid.gassi import GASSI

    place = estimator.simulator().model.input_names.index(finding.name)
    shown = input_noise(training, place)
    size = min(finding.amplitude or shown, shown)
    noisy = [replace(r, input_noise=_raised(r.input_noise, place, size)) for r in training]
    try:
        fitted = GASSI(**{**estimator.get_params(deep=False), "criterion": "auto"}).fit(noisy)
        deviations = {e.name: e.deviation for e in fitted.uncertainty(noisy).determined()}
    except ModelError:
        return replace(finding, amplitude=size, moves=())
    estimates = list(shared(uncertainty, fitted.parameters_))
    changes = [e.at(fitted.parameters_) - e.value for e in estimates]
    pairs = [(deviations.get(e.name), e.deviation) for e in estimates]
    wider = max((with_it / alone for with_it, alone in pairs if with_it and alone), default=1.0)
    return replace(finding, amplitude=size, moves=moves_of(estimates, changes), wider=wider)


def _raised(noise: FloatArray, place: int, size: float) -> FloatArray:
    raised = noise.copy()
    raised[place] = size
    return raised


@dataclass(frozen=True)
class _Suspected:
    """A model to be fitted, and the terms that were added to it, none to a variant."""

    model: ProcessModel
    terms: tuple[AddedTerm, ...] = ()


def _suspected(findings: Sequence[Finding], model: ProcessModel) -> dict[str, _Suspected]:
    """Models to be fitted by name, the surest first.

    None with a term behind what explains most and is no term: fitted without that it would stand
    for it, as a cube of an input does for its saturation.
    """
    variants = variants_of(model)
    for finding in findings:
        if finding.kind == "variant":
            parts = {name: set(v.parameter_names) for name, v in variants.items()}
            least, most = set(model.parameter_names), parts[finding.name]
            within = [name for name, between in parts.items() if least < between < most]
            return {name: _Suspected(variants[name]) for name in (finding.name, *within)}
    for finding in findings:
        if finding.term is None and finding.share > _MOST:
            return {}
        if finding.term is not None and finding.counts:
            terms = (finding.term, *finding.rivals)
            try:
                return {
                    description(replace(finding, term=term)): _Suspected(
                        with_terms(model, [term]), (term,)
                    )
                    for term in terms
                }
            except ModelError:  # it has a parameter of that name
                return {}
    return {}


_MODEL = "the model"


def fits(records: Sequence[Dataset], runs: Sequence[FloatArray]) -> FloatArray:
    """Fit [%] of free runs on records, the mean over them, (n_outputs,)."""
    pairs = zip(records, runs, strict=True)
    return mean_known(np.stack([fit_percent(r.outputs, run) for r, run in pairs]), 0)


def _moved(
    uncertainty: Uncertainty, parameters: dict[str, float]
) -> dict[str, tuple[float, float, str]]:
    """Determined quantities that the variant has outside of their intervals, the farthest first."""
    moved = []
    for estimate in shared(uncertainty, parameters):
        if estimate.deviation and estimate.excludes(parameters):
            value = estimate.at(parameters)
            far = abs(value - estimate.value) / estimate.deviation
            moved.append((far, estimate.name, (estimate.value, value, estimate.unit)))
    return {name: values for _, name, values in sorted(moved, key=lambda m: -m[0])}


def shared(uncertainty: Uncertainty, parameters: dict[str, float]) -> Iterator[Estimate]:
    """Determined quantities of parameters that another fit has as well."""
    for estimate in uncertainty.determined():
        combination = estimate.combination
        names = (estimate.name,) if combination is None else combination.names
        if all(name in parameters for name in names):
            yield estimate
