"""``rig scope``: a page that follows a run."""

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import options, terminal


def scope(
    runs: Annotated[
        list[Path] | None,
        Argument(
            metavar="RUN_OR_CSV",
            help="Capture folder or log, and others to lay behind it; default the newest run.",
        ),
    ] = None,
    out: Annotated[Path, Option(metavar="DIR", help="Where the runs are that it follows.")] = Path(
        "runs"
    ),
    port: Annotated[
        int | None,
        Option(metavar="N", min=0, max=65535, help="Of the page; default 5006, 0 for any."),
    ] = None,
    browser: Annotated[
        bool, Option("--browser/--no-browser", help="Open a browser on the page.")
    ] = True,
    json: options.AsJson = False,
) -> None:
    """Show a run in the browser, also while it is recorded."""
    from daq import scope as use_case

    named = runs or []

    def ready(address: str) -> None:
        if json:
            shown = {"run": named[0] if named else None, "behind": named[1:]}
            terminal.print_json({"address": address, **shown, "out": out})
        else:
            missing = "" if out.is_dir() else ", a folder that is not there yet"
            what = " over ".join(map(str, named)) or f"the newest run under {out}{missing}"
            print(f"{address} shows {what}; Ctrl-C ends it")
        sys.stdout.flush()
        if browser and not json and not webbrowser.open(address):
            terminal.report("note", f"no browser could be opened; open {address} in one")

    use_case.show(named, out, port, ready)
