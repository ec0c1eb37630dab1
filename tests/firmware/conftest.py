"""Tests that are marked ``patient`` are tried again on load."""

import pytest

from tests.firmware import patience


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    if item.get_closest_marker("patient") is None:
        return None
    return patience.protocol(item, nextitem)
