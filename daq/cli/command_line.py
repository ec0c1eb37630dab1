"""A command line whose commands all take ``--quiet`` and ``--verbose``."""

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import typer

from daq.cli.terminal import Volume, documents_alone, volume

Command = TypeVar("Command", bound=Callable[..., Any])
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Results and warnings only: no progress, no hints.")
]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Also which files and plugins are used.")
]


class CommandLine(typer.Typer):
    """``typer.Typer`` that gives each command these two options and keeps to them."""

    def command(self, *args: Any, **settings: Any) -> Callable[[Command], Command]:
        """Register a function as a command."""
        register = super().command(*args, **settings)

        def register_with_volume(function: Command) -> Command:
            register(_with_volume(function))
            return function

        return register_with_volume


def _with_volume(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def command(*args: Any, quiet: bool, verbose: bool, **options: Any) -> Any:
        if quiet and verbose:
            raise typer.BadParameter("give --quiet or --verbose, not both")
        level = Volume.QUIET if quiet else Volume.VERBOSE if verbose else Volume.NORMAL
        with volume(level), documents_alone(options.get("json", False)):
            return function(*args, **options)

    # Typer reads the options from the signature and the annotations.
    signature = inspect.signature(function, eval_str=True)
    kind = inspect.Parameter.KEYWORD_ONLY
    more = [
        inspect.Parameter(name, kind, default=False, annotation=annotation)
        for name, annotation in (("quiet", Quiet), ("verbose", Verbose))
    ]
    command.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*signature.parameters.values(), *more]
    )
    command.__annotations__ = {
        parameter.name: parameter.annotation
        for parameter in [*signature.parameters.values(), *more]
    }
    return command
