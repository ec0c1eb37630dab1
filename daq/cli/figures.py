"""``rig figures``: the figures of a finished identification, in other formats."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from daq.cli import options, terminal


def figures(
    run: Annotated[
        Path, Argument(metavar="RUN", help="Capture folder, or that of an identification.")
    ],
    kinds: Annotated[
        list[str] | None,
        Option("--format", help="pdf, png or svg; may be repeated. Default pdf and png."),
    ] = None,
    out: Annotated[
        Path | None, Option(metavar="DIR", help="Where they go; default beside the report.")
    ] = None,
    trust: options.Trust = False,
    json: options.AsJson = False,
) -> None:
    """Draw an identification's figures for papers and slides."""
    from daq.report.reprint import redraw

    with terminal.watching(json) as watch:
        files = redraw(run, kinds or ["pdf", "png"], out, watch, trust)
    if json:
        terminal.print_json({"figures": files})
    else:
        print(f"Figures: {files[0].parent} ({len(files)} files)")
