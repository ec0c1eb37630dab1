"""The rules for plain numbers, against those that Numba finds without them."""

import operator

import pytest
from numba import types
from numba.core.registry import cpu_target

from sysid.engine import float_types

CONTEXT = cpu_target.typing_context
FLOATS, PLANE = types.Array(types.float64, 1, "C"), types.Array(types.float64, 2, "C")
ELEMENTS = [
    (operator.getitem, (FLOATS, types.int64)),
    (operator.getitem, (PLANE, types.UniTuple(types.int64, 2))),
    (operator.setitem, (FLOATS, types.int64, types.float64)),
    (operator.setitem, (PLANE, types.UniTuple(types.int64, 2), types.float64)),
]
OTHERS = [
    (operator.getitem, (types.Array(types.int64, 1, "C"), types.int64)),
    (operator.getitem, (PLANE, types.int64)),
    (operator.setitem, (FLOATS, types.int64, types.int64)),
    (operator.add, (types.float32, types.float64)),
    (operator.add, (types.unicode_type, types.unicode_type)),
    (operator.truediv, (types.int64, types.int64)),
]


@pytest.mark.parametrize(("function", "args"), [*float_types.PAIRS, *ELEMENTS, *OTHERS])
def test_they_say_what_numba_says(function, args):
    CONTEXT.refresh()
    known = CONTEXT.resolve_value_type(function)
    ours = [t for t in known.templates if issubclass(t, float_types.Rule)]
    assert len(ours) == 1
    rest = tuple(t for t in known.templates if t not in ours)
    numba = _typed_by(rest, args)
    assert _typed_by(known.templates, args) == numba
    by_us = ours[0](CONTEXT).apply(args, {})
    assert by_us == (None if (function, args) in OTHERS else numba)


def _typed_by(templates, args):
    function = types.Function(templates[0])
    for template in templates[1:]:
        function = function.augment(types.Function(template))
    return function.get_call_type(CONTEXT, args, {})
