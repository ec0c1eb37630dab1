"""``rig figures``: the figures of a finished identification, in other formats."""

from pathlib import Path
from typing import Annotated

import typer

from daq.cli import terminal
from daq.cli.options import AsJson


def figures(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Capture folder, or that of an identification.")
    ],
    kinds: Annotated[
        list[str] | None,
        typer.Option("--format", help="pdf, png or svg; may be repeated. Default pdf and png."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where they go; default beside the report."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Draw an identification's figures for papers and slides."""
    from daq.report.reprint import redraw

    with terminal.Watching(quiet=json) as watch:
        files = redraw(run, kinds or ["pdf", "png"], out, watch)
    if json:
        terminal.print_json({"figures": [str(file) for file in files]})
    else:
        terminal.print_line(f"Figures: {files[0].parent} ({len(files)} files)")
