"""A page that shows a run's log while it grows; the run knows nothing of it."""

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path

from daq.errors import ConfigError


def show(runs: Sequence[Path], out: Path, port: int | None, ready: Callable[[str], None]) -> None:
    """Serve a page on a run, or on the newest under ``out``, until Ctrl-C or SIGTERM.

    runs: the run, and those to lay behind it. ready: is called with the page's address. Raises
    ConfigError without Bokeh, without the run, and for a port that is taken.
    """
    if importlib.util.find_spec("bokeh") is None:
        raise ConfigError(
            "rig scope needs Bokeh, which is not installed; install it with: "
            "pip install 'hybrid-rig[scope]' (in a clone: pip install -e '.[scope]')"
        )
    from daq.scope.watch import Watch

    watch = Watch(
        out, runs[0] if runs else None, runs[1:]
    )  # before the server is imported, which takes longer than a mistake may
    from daq.scope.server import serve

    serve(watch, port, ready)
