from __future__ import annotations

import os

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def kernel_cache(tmp_path_factory):
    """A cache folder of the session's own, so that no test runs on kernels of another version."""
    before = os.environ.get("RIG_CACHE_DIR")
    folder = tmp_path_factory.mktemp("kernels")
    os.environ["RIG_CACHE_DIR"] = str(folder)
    yield folder
    if before is None:
        del os.environ["RIG_CACHE_DIR"]
    else:
        os.environ["RIG_CACHE_DIR"] = before
