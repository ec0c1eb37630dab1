"""``rig scope``: a page that follows a run."""

from __future__ import annotations

import importlib.util
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from daq.cli import terminal as console
from daq.cli.options import AsJson
from daq.errors import ConfigError


def scope(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN_OR_CSV]", help="Capture folder or log; default the newest run."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where the runs are that it follows.")
    ] = Path("runs"),
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="Of the page; default 5006, 0 for any."),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open a browser on the page.")
    ] = True,
    json: AsJson = False,
) -> None:
    """Show a run in the browser, also while it is recorded."""
    scope_command(run, out, port, browser, json)


def scope_command(
    run: Path | None, out: Path, port: int | None, browser: bool, as_json: bool
) -> None:
    """Serve the page and open a browser on it, until Ctrl-C."""
    if importlib.util.find_spec("bokeh") is None:
        raise ConfigError(
            "rig scope needs Bokeh, which is not installed; install it with: "
            "pip install 'hybrid-rig[scope]' (in a clone: pip install -e '.[scope]')"
        )
    from daq.scope.recordings import Watch

    watch = Watch(out, run)  # a mistake is told before the server is imported, which takes longer
    from daq.scope.server import serve

    def ready(address: str) -> None:
        if as_json:
            console.print_json({"address": address, "run": run, "out": out})
        else:
            shown = str(run) if run else f"the newest run under {out}"
            console.print_line(f"{address} shows {shown}; Ctrl-C ends it")
        sys.stdout.flush()
        if browser and not as_json and not webbrowser.open(address):
            console.report_note(f"no browser could be opened; open {address} in one")

    serve(watch, port, ready)
