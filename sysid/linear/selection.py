"""Choice of model orders: every combination of a grid, compared on the same rows."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from sklearn.base import clone

from sysid.arrays import FloatArray
from sysid.linear.base import PolynomialModel
from sysid.linear.orders import Order
from sysid.linear.records import check_alike
from sysid.problem.data import Dataset
from sysid.problem.metrics import evaluate
from sysid.problem.model import ModelError
from sysid.problem.records import given_datasets
from sysid.threads import one_thread

Criterion = Literal["fit", "aic", "bic"]

# Orders that ``tuned`` tries.
TRIED: dict[str, Iterable[Order]] = {
    "na": range(1, 7),
    "nb": range(1, 5),
    "nc": range(4),
    "nk": (0, 1),
}


@dataclass(frozen=True)
class Candidate:
    """One combination of orders and how well it did.

    fit, rmse: (n_outputs,), free run over the validation records, in % and relative to max|y|,
    NaN without any; score: mean fit / 100; aic, bic: of the training records; radius: size of
    the largest pole; reflected: poles were moved inside; problem: why it failed, else empty.
    """

    orders: dict[str, Order]
    n_parameters: int
    fit: FloatArray
    rmse: FloatArray
    score: float = np.nan
    aic: float = np.nan
    bic: float = np.nan
    radius: float = np.nan
    reflected: bool = False
    converged: bool = False
    problem: str = ""

    @property
    def stable(self) -> bool:
        """Whether its free runs stay bounded."""
        return not self.problem and self.radius < 1.0


@dataclass(frozen=True)
class Selection:
    """candidates: best first by ``criterion``; model: the best, fitted on the training records."""

    criterion: Criterion
    candidates: tuple[Candidate, ...]
    model: Any

    @property
    def best(self) -> Candidate:
        """The chosen candidate."""
        return self.candidates[0]


def select_orders(
    estimator: PolynomialModel,
    training: Dataset | Sequence[Dataset],
    validation: Dataset | Sequence[Dataset] | None = None,
    *,
    criterion: Criterion = "fit",
    na: Iterable[Order] | None = None,
    nb: Iterable[Order] | None = None,
    nc: Iterable[Order] | None = None,
    nk: Iterable[Order] | None = None,
    threads: int = 1,
) -> Selection:
    """Fit every combination of the orders given and choose the best stable one.

    estimator: ARX or ARMAX with the settings that stay; orders not given are its own. criterion:
    ``fit``, the mean free-run fit % over outputs and validation records, as of ``score``, or
    ``bic`` or ``aic`` of the training records. Fit % is relative to each output's own spread, so
    that outputs of any scale count alike. All candidates are trained and judged on the rows that
    the longest of them has a past for. Unstable ones are listed last and never chosen;
    estimators with stable=True mend theirs. threads: the result does not depend on it. Raises
    ModelError without a validation record for ``fit``, or when no candidate is stable. Ljung,
    System Identification, section 16.4.
    """
    train, test = _datasets("training", training), _datasets("validation", validation)
    _check(criterion, train, test, threads)
    grid = _grid(estimator, {"na": na, "nb": nb, "nc": nc, "nk": nk})
    judge = _Judge(estimator, train, test, grid)
    with one_thread(), ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(judge.candidate, grid))
        costs = [_cost(candidate, criterion) for candidate in found]
        # Among equals the one with fewer coefficients.
        ranks = sorted(range(len(found)), key=lambda i: (costs[i], found[i].n_parameters))
        if not np.isfinite(costs[ranks[0]]):
            raise ModelError(_nothing(found))
        model = judge.fitted(found[ranks[0]].orders)
    return Selection(criterion, tuple(found[i] for i in ranks), model)


def tuned(
    estimator: PolynomialModel,
    records: Dataset | Sequence[Dataset],
    *,
    held_back: float = 0.3,
    **orders: Iterable[Order],
) -> Selection:
    """Choose orders by free runs over the ends of the records, then fit them to the whole.

    held_back: the part of each record that the candidates are judged by and not fitted to.
    orders: as of ``select_orders``; default na to 6, nb to 4, nc to 3, nk 0 and 1. ``model`` of
    the result is fitted to all of the records. Raises ModelError as ``select_orders``.
    """
    data = _datasets("records", records)
    first, last = [], []
    for record in data:
        cut = round(record.n_samples * (1.0 - held_back))
        first.append(record.part(0, cut, record.name))
        last.append(record.part(cut, record.n_samples, record.name))
    known = estimator.get_params()
    grid: dict[str, Any] = {name: values for name, values in TRIED.items() if name in known}
    found = select_orders(estimator, first, last, **grid | orders)
    return replace(found, model=clone(estimator).set_params(**found.best.orders).fit(data))


class _Judge:
    """Fits and scores one combination of orders after the other on the same rows."""

    def __init__(
        self,
        estimator: PolynomialModel,
        training: list[Dataset],
        validation: list[Dataset],
        grid: list[dict[str, Order]],
    ) -> None:
        self._estimator = estimator
        self._training = training
        self._validation = validation
        q, m = training[0].outputs.shape[1], training[0].inputs.shape[1]
        self._orders = [self._model(orders)._orders(q, m) for orders in grid]
        self._lag = max(orders.lag for orders in self._orders)
        self._n_outputs = q

    def _model(self, orders: dict[str, Order]) -> PolynomialModel:
        model: PolynomialModel = clone(self._estimator).set_params(**orders)
        return model

    def fitted(self, orders: dict[str, Order]) -> PolynomialModel:
        """The model of some orders, trained on the common rows."""
        model = self._model(orders)
        model._identify(model._training_data(self._training, None, None, None), self._lag)
        return model

    def candidate(self, orders: dict[str, Order]) -> Candidate:
        """Fit, simulate the validation records, score."""
        nothing = np.full(self._n_outputs, np.nan)
        try:
            model = self.fitted(orders)
        except (ModelError, np.linalg.LinAlgError) as error:
            return Candidate(orders, 0, nothing, nothing, problem=str(error))
        fits, errors = [], []
        for record in self._validation:
            # The same rows for all, whatever past each of them starts from.
            simulated = model.predict(record)[self._lag :]
            with np.errstate(all="ignore"):
                metrics = evaluate(record.outputs[self._lag :], simulated)
            fits.append(np.where(np.isfinite(simulated).all(axis=0), metrics.fit, -np.inf))
            errors.append(metrics.rmse)
        return Candidate(
            orders,
            len(model.theta_),
            _mean(fits) if fits else nothing,
            _mean(errors) if errors else nothing,
            float(_mean(np.ravel(fits))) / 100.0,
            model.aic_,
            model.bic_,
            model.radius_,
            model.reflected_,
            model.converged_,
        )


def _mean(values: Any) -> FloatArray:
    """Mean over the first axis of what is not NaN; NaN where nothing is left."""
    array = np.asarray(values, dtype=np.float64)
    counted = ~np.isnan(array)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: FloatArray = np.where(counted, array, 0.0).sum(axis=0) / counted.sum(axis=0)
    return mean


def _datasets(what: str, given: Any) -> list[Dataset]:
    if given is None:
        return []
    data = given_datasets(given)
    if data is None:
        raise ModelError(f"{what} must be a Dataset or several: Dataset(inputs, outputs, dt)")
    check_alike(data)
    return data


def _check(
    criterion: str, training: list[Dataset], validation: list[Dataset], threads: int
) -> None:
    if criterion not in ("fit", "aic", "bic"):
        raise ModelError(f"unknown criterion {criterion!r}; choose from fit, aic, bic")
    if not training:
        raise ModelError("training has no records")
    if criterion == "fit" and not validation:
        raise ModelError(
            "criterion 'fit' needs validation records: hold one back, or use criterion='bic'"
        )
    if threads < 1:
        raise ModelError(f"threads is {threads}; it must be 1 or more")


def _grid(
    estimator: PolynomialModel, given: dict[str, Iterable[Order] | None]
) -> list[dict[str, Order]]:
    settings = estimator.get_params()
    lists: list[list[Order]] = []
    for name, values in given.items():
        if name not in settings:
            if values is not None:
                raise ModelError(f"{type(estimator).__name__} has no {name}; leave it out")
            continue
        lists.append([settings[name]] if values is None else list(values))
        if not lists[-1]:
            raise ModelError(f"{name} is empty: give at least one order to try")
    names = [name for name in given if name in settings]
    return [dict(zip(names, orders, strict=True)) for orders in itertools.product(*lists)]


def _cost(candidate: Candidate, criterion: str) -> float:
    """To be minimised; infinite for a candidate that must not be chosen."""
    if not candidate.stable:
        return np.inf
    cost = {"fit": -candidate.score, "aic": candidate.aic, "bic": candidate.bic}[criterion]
    return np.inf if np.isnan(cost) else cost


def _nothing(candidates: Sequence[Candidate]) -> str:
    problems = [candidate.problem for candidate in candidates if candidate.problem]
    if problems:
        return f"none of the {len(candidates)} candidates can be used; the first: {problems[0]}"
    return (
        f"none of the {len(candidates)} candidates is stable: give the estimator stable=True, or "
        "try lower na"
    )
