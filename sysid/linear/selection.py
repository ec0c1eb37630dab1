"""Choice of model orders: every combination of a grid, compared on the same rows."""

import itertools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sysid.arrays import FloatArray
from sysid.linear.estimator import PolynomialModel, check_alike, free_run_fit
from sysid.linear.polynomials import Order
from sysid.problem.data import Dataset
from sysid.problem.metrics import mean_known
from sysid.problem.model import ModelError
from sysid.problem.records import given_datasets
from sysid.threads import one_thread

Criterion = Literal["fit", "aic", "bic"]
Orders = dict[str, Order]
Grid = Iterable[Order]
Records = Dataset | Sequence[Dataset]

# Orders that ``tuned`` tries.
TRIED: dict[str, Any] = {
    "na": range(1, 7),
    "nf": range(1, 7),
    "nb": range(1, 5),
    "nc": range(4),
    "nk": (0, 1),
}


@dataclass(frozen=True)
class OrderCandidate:
    """One combination of orders and how well it did.

    fit, rmse: (n_outputs,), free run over the validation records, in % and relative to max|y|;
    score: mean fit / 100; aic, bic: of the training records; radius: size of the largest pole;
    reflected: poles were moved inside; problem: why it failed, else empty.
    """

    orders: Orders
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

    def cost(self, criterion: Criterion) -> float:
        """To be minimised; infinite for a candidate that must not be chosen."""
        cost = {"fit": -self.score, "aic": self.aic, "bic": self.bic}[criterion]
        return np.inf if np.isnan(cost) or not self.stable else cost


@dataclass(frozen=True)
class Selection:
    """candidates: best first by ``criterion``; model: the best, fitted on the training records."""

    criterion: Criterion
    candidates: tuple[OrderCandidate, ...]
    model: Any

    @property
    def best(self) -> OrderCandidate:
        """The chosen candidate."""
        return self.candidates[0]


def select_orders(
    estimator: PolynomialModel,
    training: Records,
    validation: Records | None = None,
    *,
    criterion: Criterion = "fit",
    na: Grid | None = None,
    nb: Grid | None = None,
    nc: Grid | None = None,
    nk: Grid | None = None,
    nf: Grid | None = None,
    threads: int = 1,
) -> Selection:
    """Fit every combination of the orders given and choose the best stable one.

    estimator: ARX, ARMAX or OE with the settings that stay; orders not given are its own.
    criterion: ``fit``, the ``score`` over the validation records; ``bic`` or ``aic`` of training.
    All candidates are trained and judged on the rows that the longest has a past for. Of OE, by
    ``fit``, each output's own best orders are a further candidate. Unstable
    ones come last and are never chosen; stable=True mends them. The result does not depend on
    threads. Raises ModelError without a validation record for ``fit``, or when no candidate is
    stable. Ljung, System Identification, section 16.4.

    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> from sysid import ARX, Dataset
    >>> u, e = np.random.default_rng(0).normal(size=(2, 200))
    >>> record = Dataset(u, lfilter([0.0, 0.2], [1.0, -1.5, 0.7], u + 0.1 * e), dt=0.01)
    >>> select_orders(ARX(), record, criterion="bic", na=range(1, 4), nb=(1,)).best.orders
    {'na': 2, 'nb': 1, 'nk': 1}
    """
    train, test = _datasets("training", training), _datasets("validation", validation)
    if criterion not in ("fit", "aic", "bic"):
        raise ModelError(f"unknown criterion {criterion!r}; choose from fit, aic, bic")
    if not train:
        raise ModelError("training has no records")
    if criterion == "fit" and not test:
        raise ModelError(
            "criterion 'fit' needs validation records: hold one back, or use criterion='bic'"
        )
    if threads < 1:
        raise ModelError(f"threads is {threads}; it must be 1 or more")
    grid = _grid(estimator, {"nf": nf, "na": na, "nb": nb, "nc": nc, "nk": nk})
    lag = max(estimator.like(**orders)._layout(train[0]).lag for orders in grid)
    judge = _Judge(estimator, train, test, lag)
    with one_thread(), ThreadPoolExecutor(threads) as pool:
        candidates = list(pool.map(judge.candidate, grid))
        if estimator.separate and criterion == "fit":
            candidates += judge.mixed(candidates)
        candidates.sort(key=lambda candidate: (candidate.cost(criterion), candidate.n_parameters))
        if not np.isfinite(candidates[0].cost(criterion)):
            problems = [f"can be used; the first: {c.problem}" for c in candidates if c.problem]
            problems.append("is stable: give the estimator stable=True, or try lower na")
            raise ModelError(f"none of the {len(candidates)} candidates {problems[0]}")
        return Selection(criterion, tuple(candidates), judge.fitted(candidates[0].orders))


def tuned(
    estimator: PolynomialModel, records: Records, *, held_back: float = 0.3, **orders: Grid
) -> Selection:
    """Choose orders by free runs over the ends of the records, then fit them to the whole.

    held_back: the part of each record that candidates are judged by and not fitted to. orders,
    errors: as of ``select_orders``; default na and nf to 6, nb to 4, nc to 3, nk 0 and 1.
    """
    first, last = [], []
    for record in (data := _datasets("records", records)):
        cut = round(record.n_samples * (1.0 - held_back))
        first.append(record.part(0, cut, record.name))
        last.append(record.part(cut, record.n_samples, record.name))
    grid = {name: TRIED[name] for name in TRIED.keys() & estimator.get_params()}
    selection = select_orders(estimator, first, last, **grid | orders)
    return replace(selection, model=estimator.like(**selection.best.orders).fit(data))


class _Judge(NamedTuple):
    """Fits and scores combinations of orders on the rows from ``lag`` on."""

    estimator: PolynomialModel
    training: list[Dataset]
    validation: list[Dataset]
    lag: int

    def fitted(self, orders: Orders) -> PolynomialModel:
        model: PolynomialModel = self.estimator.like(**orders)
        model._fit_rows(self.lag, self.training)
        return model

    def mixed(self, candidates: Sequence[OrderCandidate]) -> list[OrderCandidate]:
        """Each output with the orders that serve it best, of a model whose outputs are separate."""
        usable = [candidate for candidate in candidates if not candidate.problem]
        if not usable:
            return []
        best = [usable[j].orders for j in np.argmax([c.fit for c in usable], axis=0)]
        orders: Orders = {
            name: [of_output(orders[name], j) for j, orders in enumerate(best)] for name in best[0]
        }
        return [self.candidate(orders)]

    def candidate(self, orders: Orders) -> OrderCandidate:
        nothing = np.full(self.training[0].outputs.shape[1], np.nan)
        try:
            model = self.fitted(orders)
        except (ModelError, np.linalg.LinAlgError) as error:
            return OrderCandidate(orders, 0, nothing, nothing, problem=str(error))
        pairs = [(record.outputs, model.predict(record)) for record in self.validation]
        runs = [free_run_fit(outputs[self.lag :], run[self.lag :]) for outputs, run in pairs]
        attributes = ("aic", "bic", "radius", "reflected", "converged")
        fits, errors = np.reshape(runs, (-1, 2, len(nothing))).swapaxes(0, 1)
        return OrderCandidate(
            orders,
            len(model.theta_),
            mean_known(fits, axis=0),
            mean_known(errors, axis=0),
            float(mean_known(fits)) / 100.0,
            **{name: getattr(model, f"{name}_") for name in attributes},
        )


def of_output(order: Any, j: int) -> Any:
    """What an order, one for all outputs or a table, says of output j."""
    return order if np.ndim(order) == 0 else order[j]


def _datasets(name: str, records: Any) -> list[Dataset]:
    if records is None:
        return []
    data = given_datasets(records)
    if data is None:
        raise ModelError(f"{name} must be a Dataset or several: Dataset(inputs, outputs, dt)")
    check_alike(data)
    return data


def _grid(estimator: PolynomialModel, orders: dict[str, Grid | None]) -> list[Orders]:
    settings, grid = estimator.get_params(), {}
    for name, values in orders.items():
        if name in settings:
            grid[name] = [settings[name]] if values is None else list(values)
            if not grid[name]:
                raise ModelError(f"{name} is empty: give at least one order to try")
        elif values is not None:
            raise ModelError(f"{type(estimator).__name__} has no {name}; leave it out")
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
