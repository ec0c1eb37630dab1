# mypy: ignore-errors
"""Types of arithmetic on plain numbers, found by the compiler before it looks at anything else.

A kernel is thousands of operations on floats, and for each Numba tries NumPy's arrays, dates, lists
and strings before it comes to floats: half of its time. These rules say the same sooner. Registered
for the processor, they come before all that hold for any target
(https://numba.readthedocs.io/en/stable/extending/low-level.html).
"""

import operator
from itertools import product
from typing import Any, ClassVar

from numba import types
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature

_FLOAT, _INT, _BOOL = types.float64, types.int64, types.boolean
_SAME = (
    operator.add, operator.iadd, operator.sub, operator.isub, operator.mul, operator.imul,
)  # fmt: skip
_COMPARISONS = (
    operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne,
)  # fmt: skip
_FLOATS = (operator.truediv, operator.itruediv)


def _pairs() -> dict[tuple[Any, tuple[Any, Any]], Signature]:
    """Signatures by operator and types of both sides."""
    rules = {}
    for left, right in product((_FLOAT, _INT), repeat=2):
        common = _INT if left == right == _INT else _FLOAT
        rules |= {(op, (left, right)): signature(common, common, common) for op in _SAME}
        rules |= {(op, (left, right)): signature(_BOOL, common, common) for op in _COMPARISONS}
    return rules | {(op, (_FLOAT,) * 2): signature(_FLOAT, _FLOAT, _FLOAT) for op in _FLOATS}


PAIRS = _pairs()


class Rule(AbstractTemplate):
    """A rule for the processor."""

    metadata: ClassVar = {"target": "cpu"}


class _OfPairs(Rule):
    def generic(self, args: Any, kws: Any) -> Signature | None:
        return None if kws else PAIRS.get((self.key, tuple(args)))


for _operator in (*_SAME, *_COMPARISONS, *_FLOATS):
    infer_global(_operator)(type("Pairs", (_OfPairs,), {}))


def _is_element(array: Any, index: Any) -> bool:
    """Whether an index of integers leads to a float of an array."""
    if not (isinstance(array, types.Array) and array.dtype == _FLOAT):
        return False
    return index == (_INT if array.ndim == 1 else types.UniTuple(_INT, array.ndim))


@infer_global(operator.getitem)
class _Element(Rule):
    def generic(self, args: Any, kws: Any) -> Signature | None:
        return signature(_FLOAT, *args) if _is_element(*args) else None


@infer_global(operator.setitem)
class _ElementSet(Rule):
    def generic(self, args: Any, kws: Any) -> Signature | None:
        array, index, value = args
        plain = _is_element(array, index) and array.mutable and value == _FLOAT
        return signature(types.none, *args) if plain else None
