"""``rig scope``: a page that follows a run."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path

from daq import scope
from daq.cli import terminal as console


def scope_command(
    run: Path | None, out: Path, port: int | None, browser: bool, as_json: bool
) -> None:
    """Serve the page and open a browser on it, until Ctrl-C."""

    def ready(address: str) -> None:
        if as_json:
            console.print_json({"address": address, "run": run, "out": out})
        else:
            shown = str(run) if run else f"the newest run under {out}"
            console.print_line(f"{address} shows {shown}; Ctrl-C ends it")
        sys.stdout.flush()
        if browser and not as_json and not webbrowser.open(address):
            console.report_note(f"no browser could be opened; open {address} in one")

    scope.show(run, out, port, ready)
