import pytest

from tests.daq.support import forked_rig


@pytest.fixture(scope="session")
def command():
    """``rig`` processes of arguments and folder, whose imports are done once."""
    with forked_rig() as run:
        yield run
