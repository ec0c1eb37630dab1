"""Long sweeps: a share of them in every run, the rest under the marker ``soak``."""

import pytest


def mostly_soak(values, always=1):
    """Values for ``parametrize``, of which the first ``always`` run every time."""
    rest = [pytest.param(*_as_tuple(value), marks=pytest.mark.soak) for value in values[always:]]
    return [*values[:always], *rest]


def _as_tuple(value):
    return value if isinstance(value, tuple) else (value,)
